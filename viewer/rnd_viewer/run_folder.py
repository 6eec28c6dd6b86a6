"""One folder for a run, also where several processes render parts of it.

A run is known by its settings and inputs. The process that finds no mark of its run in the folder leaves one and takes
away what other runs left, but nothing that is younger than the mark: that is of processes that render other parts of
the same run. What is older than every other run's mark is the user's own.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from rnd_runtime.files import sha256_of

_MARK = ".run-"
_FRAME = re.compile(
    r"\d{6,}\.(png|exr)"
)  # a picture as writers.py names it, and nothing that a user put there
_PICTURES = ("frames/*", "frames_exr/*", "aov/*/*")  # and nothing deeper, see writers.py
_WHOLE = re.compile(r"play(_\d{6,}-\d{6,})?\.(json|mp4|webp)")  # beside them, see part_name
_OF_A_RUN = re.compile(rf"(frames|frames_exr|aov/[^/]+)/{_FRAME.pattern}|{_WHOLE.pattern}")


def claim(folder: Path, settings: Mapping[str, object], inputs: Iterable[Path]) -> int:
    """Make ``folder`` the folder of the run with ``settings`` on the files ``inputs``, and free of others'.

    How many files of other runs were removed.
    """
    mark = folder / f"{_MARK}{_identity(settings, inputs)}"
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return 0
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
    files = (file for file in [*frames, *whole] if file.is_file())
    left = [file for file in files if oldest <= file.stat().st_mtime_ns < began]
    for file in left:
        file.unlink(missing_ok=True)
    for other in others:
        other.unlink(missing_ok=True)
    return len(left)


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
