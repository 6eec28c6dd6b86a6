"""The options of ``rnd-view``; each comment is the option's help."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.core.errors import InputError, refuse_outside
from rnd_viewer.inputs.options import LitOptions, option

SIZES = 64, 2048  # px: the least and the largest side of a picture


@dataclass(frozen=True)
class ViewOptions(LitOptions):
    """Look at an avatar in the browser: rotate it, play it, relight it; or watch a training. No GPU needed.

    rnd-view avatar.onnx --motion walk.npz --hdr sky.exr
    """

    avatar: Annotated[tyro.conf.Positional[Path], option("AVATAR.onnx|RUN")]
    """An avatar of rnd-export, or a folder of rnd-train: its losses and previews while it trains, then its avatar."""
    motion: Annotated[Path | None, option("FILE")] = None
    """Body poses over time, in any format that rnd-play takes. Default: the capture's, else the pose at rest."""
    hdr: Annotated[tuple[Path, ...], option("FILE|FOLDER ...")] = field(default_factory=tuple)
    """Light probes to choose from, .exr or .hdr, or folders of them. The avatar's own light is always there."""
    capture: Annotated[Path | None, option("FOLDER")] = None
    """A capture: its pictures can be shown beside the avatar, from their cameras and under their lights."""

    host: str = "127.0.0.1"
    """Address to listen on. Anything but this machine's own asks every visitor for a token, which is printed."""
    port: int = 8008
    """Port to listen on; 0 takes any that is free."""
    size: int = 512
    """Picture size in pixels to begin with."""
    raster: Literal["auto", "gl", "cpu"] = "auto"
    """Rasteriser: auto takes GL on a graphics card and the CPU kernel otherwise."""
    threads: Annotated[int | None, option("INT")] = None
    """CPU threads. Default: all."""
    fps_floor: Annotated[float | None, option("FLOAT")] = None
    """Frames per second to hold while the avatar plays, at a lower resolution where needed. Screenshots and clips
    keep the full one."""
    browser: bool = True
    """Open the page in this machine's browser."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion is None:
            captured = self.capture is not None
            ours = "the capture's own is read by its rules" if captured else "the pose at rest does not move"
            self.refuse_unread(f"needs --motion: {ours}", edited=captured)
        refuse_outside(self, {"fps_floor": (1e-3, 1000)})
        if not 0 <= self.port <= 65535:
            raise InputError("--port", expected="0 to 65535", got=self.port)
        low, high = SIZES
        if not low <= self.size <= high:
            raise InputError("--size", expected=f"{low} to {high}", got=self.size)

    @property
    def local(self) -> bool:
        """Whether nobody but this machine can reach ``host``."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"
