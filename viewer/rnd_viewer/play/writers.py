"""What a run leaves in its folder. Every file is complete or absent, also after Ctrl-C.

::

    out/frames/000010.png        the frame: 8-bit sRGB, with straight alpha when there is no background
    out/frames_exr/000010.exr    linear R, G, B, A (premultiplied) and one layer for each AOV, see ``play.exr``
    out/aov/normal/000010.png    AOVs as images
    out/play.mp4, .webm, …       clips; WebP, WebM (VP9) and MOV (ProRes 4444) are transparent where the PNG is
    out/play.json                settings, notes, stage times
    out/play_000010-000050.*     the same of a part of a run, see ``play.run_folder``
    out/.mp4/000010.png          a frame of a clip that is joined when all parts are done
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import output_folder
from rnd_runtime.core.images import read_image, write_image
from rnd_runtime.playback.aov import aov_image
from rnd_runtime.playback.frame import RenderedFrame

from .exr import ExrWriter
from .timing import StageTimes
from .video import CLIPS, clip_writer, load_pyav

FORMATS = ("png", "exr", *CLIPS)
TRANSPARENT = {"png", "webp", "webm", "mov"}  # without a background
FrameWriter = Callable[[int, RenderedFrame, tuple[float, float], Camera], None]


def parse_formats(text: str | None) -> tuple[str, ...]:
    """``png,exr`` → names; None → png and, where PyAV is installed, mp4."""
    if text is None:
        return ("png", "mp4") if importlib.util.find_spec("av") else ("png",)
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or names - set(FORMATS):
        raise InputError("--format", expected=f"some of {','.join(FORMATS)}", got=text or "nothing")
    if names & set(CLIPS):
        load_pyav(", or --format png")
    return tuple(name for name in FORMATS if name in names)


def tone_map_for(formats: tuple[str, ...], frame: RenderedFrame) -> None:
    """Let ``frame`` make the pixels that ``formats`` need, which it keeps: before it goes to a writer's thread."""
    for name in formats:
        if name != "exr":
            _pixels(name, frame)


def _pixels(name: str, frame: RenderedFrame) -> NDArray[np.uint8]:
    """The pixels of ``frame`` for one of the formats that have 8 bits."""
    return frame.srgb_alpha if name in TRANSPARENT and frame.background is None else frame.srgb


@contextmanager
def frame_writer(
    folder: Path,
    formats: tuple[str, ...],
    *,
    name: str = "play",
    fps: float,
    times: StageTimes,
    begin: Callable[[int], None] = lambda number: None,
    exr: ExrWriter | None = None,
    to_join: bool = False,
) -> Iterator[FrameWriter]:
    """Yield ``write(number, frame, reach, camera)``, which puts one frame into ``folder`` in all of ``formats``.

    ``reach`` is the range of depths in metres that the depth image spans, ``camera`` that of the frame. AOVs go into
    the EXR if there is one, and into images of their own if PNG is asked for or there is no EXR. Clips, called
    ``name``, appear at the end, or by ``join_clips`` if they are ``to_join``. ``begin(number)`` is called when the
    clips have taken a frame, which they may refuse, and before any file of it is written.
    """
    output_folder(folder)
    with ExitStack() as clips:
        append = {
            kind: clips.enter_context(clip_writer(folder / f"{name}.{kind}", fps=fps))
            for kind in formats
            if kind in CLIPS and not to_join
        }

        exr_writer = exr or ExrWriter(fps)

        def write(number: int, frame: RenderedFrame, reach: tuple[float, float], camera: Camera) -> None:
            files: dict[Path, NDArray[np.uint8]] = {}
            number_name = f"{number:06d}"
            with times.stage("write"):
                for kind, add in append.items():
                    add(_pixels(kind, frame))
                begin(number)
                if "png" in formats:
                    files[folder / f"frames/{number_name}.png"] = _pixels("png", frame)
                for kind in {*CLIPS} & {*formats} - append.keys():
                    files[folder / f".{kind}/{number_name}.png"] = _pixels(kind, frame)
                if "png" in formats or "exr" not in formats:
                    for aov, values in frame.aovs.items():
                        image = aov_image(aov, values, frame.alpha, reach)
                        files[folder / f"aov/{aov}/{number_name}.png"] = image
                for path, pixels in files.items():
                    write_image(path, pixels)
                if "exr" in formats:
                    exr_writer.write(folder / f"frames_exr/{number_name}.exr", frame, camera)

        yield write


def join_clips(folder: Path, formats: Sequence[str], frames: Iterable[int], *, name: str, fps: float) -> None:
    """Make the clips of ``frames`` that parts of a run have written ``to_join``."""
    for kind in (kind for kind in formats if kind in CLIPS):
        with clip_writer(folder / f"{name}.{kind}", fps=fps) as add:
            for number in frames:
                add(np.asarray(read_image(folder / f".{kind}/{number:06d}.png"), np.uint8))
        shutil.rmtree(folder / f".{kind}")


def is_written(folder: Path, formats: Sequence[str], aovs: Sequence[str], number: int) -> bool:
    """Whether all files of the frame are there, and of clips those ``to_join``."""
    folders = {"png": "frames", "exr": "frames_exr"} | {kind: f".{kind}" for kind in CLIPS}
    files = [f"{folders[kind]}/{number:06d}.{'exr' if kind == 'exr' else 'png'}" for kind in formats]
    if "png" in formats or "exr" not in formats:
        files += [f"aov/{aov}/{number:06d}.png" for aov in aovs]
    return all((folder / file).is_file() for file in files)
