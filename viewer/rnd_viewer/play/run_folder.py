"""One folder for a run, also where several processes render parts of it.

A run is known by its settings and inputs. The process that finds no mark of its run in the folder takes away what other
runs left and then leaves one; processes of other parts wait for that. What is older than every other run's mark is the
user's own.

The mark is its own lock, which the system releases when a process ends; it is empty until all is taken away, so that
an interrupted process is made up for. On NFS the server locks. Where nothing does, a file is looked at just before it
is removed: one younger than the mark is of another part.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO

from rnd_runtime.core.files import sha256_of

if sys.platform != "win32":
    import fcntl

_MARK = ".run-"
_FRAME = re.compile(r"\d{6,}\.(png|exr)")  # a picture as writers.py names it, and nothing that a user put there
_PICTURES = ("frames/*", "frames_exr/*", "aov/*/*")  # and nothing deeper, see writers.py
_WHOLE = re.compile(r"play(_\d{6,}-\d{6,})?\.(json|mp4|webp)")  # beside them, see part_name
_OF_A_RUN = re.compile(rf"(frames|frames_exr|aov/[^/]+)/{_FRAME.pattern}|{_WHOLE.pattern}")


def claim(folder: Path, settings: Mapping[str, object], inputs: Iterable[Path]) -> int:
    """Make ``folder`` the folder of the run with ``settings`` on the files ``inputs``, and free of others'.

    How many files of other runs were removed.
    """
    mark = folder / f"{_MARK}{_identity(settings, inputs)}"
    with mark.open("a", encoding="utf-8") as file:
        _lock(file)
        if os.fstat(file.fileno()).st_size:
            return 0
        mark.touch()  # an interrupted process may have left it long ago
        removed = _take_away(folder, mark)
        file.write("what other runs left was taken away\n")
    return removed


def _lock(file: IO[str]) -> None:
    """Wait until no other process has ``file`` locked, and lock it until it is closed."""
    if sys.platform != "win32":
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)


def _take_away(folder: Path, mark: Path) -> int:
    """Remove what other runs than that of ``mark`` left in ``folder``, then their marks; how many files."""
    others = [other for other in folder.glob(f"{_MARK}*") if other != mark]
    if not others:
        return 0
    try:
        began = mark.stat().st_mtime_ns
        oldest = min(other.stat().st_mtime_ns for other in others)
    except FileNotFoundError:  # another run has claimed the folder since
        return 0
    frames = (file for place in _PICTURES for file in folder.glob(place) if _FRAME.fullmatch(file.name))
    whole = (file for file in folder.iterdir() if _WHOLE.fullmatch(file.name))
    removed = 0
    for file in [*frames, *whole]:
        with suppress(FileNotFoundError):  # as above
            if file.is_file() and oldest <= file.stat().st_mtime_ns < began:
                file.unlink()
                removed += 1
    for other in others:
        other.unlink(missing_ok=True)
    return removed


def is_of_a_run(file: Path, folder: Path) -> bool:
    """Whether ``file`` lies in ``folder`` under a name that runs write there, and take away."""
    file, folder = file.resolve(), folder.resolve()
    return file.is_relative_to(folder) and bool(_OF_A_RUN.fullmatch(file.relative_to(folder).as_posix()))


def part_name(stem: str, frames: range, count: int) -> str:
    """``play`` for a run of all ``count`` frames, ``play_000010-000050`` for a part, so that parts share a folder."""
    whole = frames.start == 0 and frames.stop == count
    return stem if whole else f"{stem}_{frames.start:06d}-{frames.stop:06d}"


def _identity(settings: Mapping[str, object], inputs: Iterable[Path]) -> str:
    """What two processes of one run agree on, on several machines too: settings, and the content of every input."""
    contents = [sha256_of(path) for path in inputs if path.is_file()]
    text = json.dumps([settings, contents], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
