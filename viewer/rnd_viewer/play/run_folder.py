"""One folder for a run, also where several processes render parts of it.

A run is identified by its settings and the content of its inputs; a hidden file, ``.run-ID``, marks its folder. A
folder with frames or clips of another run or a user is refused.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from rnd_runtime.cli.command import size_text
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of
from rnd_viewer.inputs.cameras import split_camera
from rnd_viewer.inputs.options import OWN_CAMERAS, PlayOptions

from .video import CLIPS

_FOLDERS = ("frames/[!.]*", "frames_exr/[!.]*", "aov/*/[!.]*", *(f".{kind}/[!.]*" for kind in CLIPS))
_CLIP = re.compile(r"play(_\d{6,}-\d{6,})?\.(json|mp4|webp|webm|mov)")
_OF_A_RUN = re.compile(rf"(frames|frames_exr|aov/[^/]+)/\d{{6,}}\.(png|exr)|{_CLIP.pattern}")
_OWN_TO_A_PROCESS = {"frames", "threads", "format", "raster"}  # options that may differ between parts of a run
_FILES = {"avatar", "motion", "hdr", "joint_map"}  # a run is identified by their content


def common_settings(options: PlayOptions) -> dict[str, object]:
    """The settings that all processes of one run share, beside its ``_inputs``."""
    settings = settings_of(options)
    if options.view.camera not in OWN_CAMERAS:
        settings["camera"] = split_camera(options.view.camera)[1]
    return {key: value for key, value in settings.items() if key not in _OWN_TO_A_PROCESS | _FILES}


def settings_of(options: PlayOptions) -> dict[str, object]:
    """The options as JSON has them, without the folder: two runs into two folders give the same report."""
    values = {name: str(value) if isinstance(value, Path) else value for name, value in options.settings().items()}
    values["size"] = None if options.size is None else size_text(options.size)
    return {name: value for name, value in values.items() if name not in ("out", "doctor", "on", "skip_existing")}


def mark_of(folder: Path, settings: Mapping[str, object], inputs: Iterable[Path]) -> Path:
    """The mark of the run with ``settings`` on the files ``inputs`` in ``folder``: the same on several machines."""
    contents = [sha256_of(path) for path in inputs if path.is_file()]
    text = json.dumps([settings, contents], sort_keys=True, default=str)
    return folder / f".run-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def refuse_others(mark: Path) -> None:
    """Raise ``InputError`` if the folder of ``mark`` holds frames or clips, but not the mark."""
    folder = mark.parent
    frames = (file for pattern in _FOLDERS for file in folder.glob(pattern) if file.is_file())
    clips = (file for file in folder.glob("play*") if _CLIP.fullmatch(file.name))
    found = next(frames, None) or next(clips, None)
    if found is not None and not mark.exists():  # in this order: other parts of the run mark first, then write
        what = f"--out holds {found.relative_to(folder)}, which this run did not write"
        raise InputError(what, file=folder, hint="choose another --out, or remove what is there")


def is_of_a_run(file: Path, folder: Path) -> bool:
    """Whether ``file`` is in ``folder`` under a name that runs write there."""
    file, folder = file.resolve(), folder.resolve()
    return file.is_relative_to(folder) and bool(_OF_A_RUN.fullmatch(file.relative_to(folder).as_posix()))


def part_name(stem: str, frames: range, count: int) -> str:
    """``play`` for a run of all ``count`` frames, ``play_000010-000050`` for a part, so that parts share a folder."""
    whole = frames.start == 0 and frames.stop == count
    return stem if whole else f"{stem}_{frames.start:06d}-{frames.stop:06d}"
