"""The options of ``rnd-view``; each comment is the option's help."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import (
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalNumber,
    OptionalSize,
    option,
    size_text,
)
from rnd_runtime.core.errors import InputError, refuse_changed, refuse_outside
from rnd_viewer.inputs.options import GAIN, MotionGroup, MotionOptions, ProbeUp, parse_gain
from rnd_viewer.inputs.scenes import is_scene

SIZES = 64, 2048  # px: the least and the largest side of a frame


@dataclass(frozen=True)
class ViewOptions:
    """Look at an avatar in the browser: rotate it, play it, relight it; or watch a training. No GPU needed.

    rnd-view avatar.onnx --motion walk.npz --hdr sky.exr
    """

    avatar: Annotated[tyro.conf.Positional[Path], option("AVATAR.onnx|SCENE.toml|RUN")]
    """An avatar of rnd-export; several, in a scene file (docs/formats.md); or a folder of rnd-train: its losses and
    previews while it trains, then its avatar."""
    motion: OptionalFile = None
    """Body poses over time, in any format that rnd-play takes. Default: the capture's, else the rest pose."""
    hdr: Annotated[tuple[Path, ...], option("FILE|FOLDER ...")] = ()
    """Light probes to choose from, .exr or .hdr, or folders of them. The avatar's own light is always there."""
    hdr_up: ProbeUp = "y"
    """Up axis of the probes' files."""
    albedo_gain: Annotated[str, option(GAIN)] = "1"
    """Factors on the albedo, linear."""
    capture: OptionalFolder = None
    """A capture: its images can be shown beside the avatar, from their cameras and under their lights."""

    host: Annotated[str, option("ADDRESS")] = "127.0.0.1"
    """Address to listen on. Every visitor needs the token in the address that is printed."""
    port: Annotated[int, option("N")] = 8008
    """Port to listen on; 0 takes any that is free."""
    browser: bool = True
    """Open the page in this machine's browser, whose command line then shows the token."""

    size: OptionalSize = None
    """Size of a frame in pixels to begin with. Default: the window's."""
    fps_floor: OptionalNumber = None
    """Frames per second to hold, at a lower resolution where needed. Screenshots and clips keep the full one."""
    raster: Literal["auto", "gl", "cpu"] = "auto"
    """Rasteriser: auto takes GL on a graphics card and the CPU kernel otherwise."""
    threads: OptionalCount = None
    """CPU threads. Default: all."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def __post_init__(self) -> None:
        if not self.hdr:
            refuse_changed(self, ["hdr_up"], "needs --hdr")
        scene = is_scene(self.avatar)
        if scene:
            refuse_changed(self, ["motion", "capture"], "the scene has its motions")
        if self.motion is None and not scene:
            captured = self.capture is not None
            ours = "the capture's own is read by its rules" if captured else "the rest pose does not move"
            self.reading.refuse_unread(f"needs --motion: {ours}", edited=captured)
        parse_gain(self.albedo_gain)
        refuse_outside(self, {"fps_floor": (1e-3, 1000)})
        if not 0 <= self.port <= 65535:
            raise InputError("--port", expected="0 to 65535", got=self.port)
        low, high = SIZES
        if self.size and not all(low <= side <= high for side in self.width_height):
            raise InputError("--size", expected=f"{low} to {high}", got=size_text(self.size))

    @property
    def width_height(self) -> tuple[int, int]:
        """Of a frame, px."""
        width, height = self.size or (512, None)
        return width, height or width


def probes(paths: tuple[Path, ...]) -> list[Path]:
    """The light probes among ``paths`` and in their folders."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix.lower() in (".exr", ".hdr"))
            if not inside:
                raise InputError("--hdr", expected="light probes, .exr or .hdr", got="none", file=path)
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise InputError("light probe not found", file=path)
    return files
