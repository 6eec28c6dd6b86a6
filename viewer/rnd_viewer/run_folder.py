"""One folder for a run, also where several processes render parts of it.

A run is known by its settings and inputs. The process that finds no mark of its run in the folder leaves one and takes
away what other runs left, but nothing that is younger than the mark: that is of processes that render other parts of
the same run. Where no other run left a mark, pictures are the user's own.
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
        oldest = mark.stat().st_mtime_ns
    except FileNotFoundError:  # another run has claimed the folder since
        return 0
    frames = (file for place in _PICTURES for file in folder.glob(place) if _FRAME.fullmatch(file.name))
    whole = (file for file in folder.iterdir() if _WHOLE.fullmatch(file.name))
    left = [file for file in [*frames, *whole] if file.is_file() and file.stat().st_mtime_ns < oldest]
    for file in left:
        file.unlink(missing_ok=True)
    for other in others:
        other.unlink(missing_ok=True)
    return len(left)


def part_name(stem: str, frames: range, count: int) -> str:
    """``play`` for a run of all ``count`` frames, ``play_000010-000050`` for a part, so that parts share a folder."""
    whole = frames.start == 0 and frames.stop == count
    return stem if whole else f"{stem}_{frames.start:06d}-{frames.stop:06d}"


def _identity(settings: Mapping[str, object], inputs: Iterable[Path]) -> str:
    """What two processes of one run agree on, on several machines too: settings, and the content of every input."""
    contents = [sha256_of(path) for path in inputs if path.is_file()]
    text = json.dumps([settings, contents], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
