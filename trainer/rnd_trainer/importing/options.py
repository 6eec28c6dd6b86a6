"""What the user says about a source: the options of ``rnd-data import``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

Up = Literal["x", "-x", "y", "-y", "z", "-z"]


@dataclass(frozen=True)
class Choice:
    """Which pictures become part of the capture."""

    train_camera: str | None = None
    """whose first 4/5 are trained on; the first"""
    held_out_every: int = 30
    """of the other cameras, one frame in so many is a novel view"""
    every: int = 1
    """keep frames whose number is a multiple of this"""
    start: int = 0
    """first frame number to keep"""
    stop: int | None = None
    """frame number to stop before"""

    def keeps(self, frame: int) -> bool:
        """Whether the frame of this number may be taken."""
        return self.start <= frame < (frame + 1 if self.stop is None else self.stop) and frame % self.every == 0


ALL = Choice()
"""every frame that there is"""


@dataclass(frozen=True)
class ImportOptions:
    """How to read a source, and what to take of it."""

    body: str | None = None
    """SMPL, SMPL-H or SMPL-X (.npz or .pkl), a body.npz, or the word anny"""
    layout: Annotated[str | None, tyro.conf.arg(name="as")] = None
    """what SOURCE is, where it is not found out rightly; smpl or easymocap: how the root of the poses is meant;
    both as nerfstudio,smpl"""
    poses: Path | None = None
    """body poses from WHAM, GVHMR, 4D-Humans, ROMP, EasyMocap or an SMPL .npz"""
    person: int | None = None
    """track number in --poses"""
    masks: Path | None = None
    """folder of masks (.png, .npy), called or numbered like the frames (a video's first is 0), in a folder a
    camera where there are several; without one, rough masks are made"""
    mask_net: Path | None = None
    """segmentation network (.onnx) to make masks with, instead of the source's"""
    normals: Path | None = None
    """folder of normal maps (.npy, .png), called or numbered like the frames, in a folder a camera where there are
    several"""
    normal_net: Path | None = None
    """normal network (.onnx) to make normals with, instead of the source's"""
    normal_axes: str | None = None
    """such as x,-y,-z: which of the maps' axes are our right, down, forward; found by the template when not given. A
    data set's own normals are read as it promises, and turned by this"""
    intrinsics: tuple[float, ...] = ()
    """fx fy cx cy of a video, in pixels"""
    distortion: tuple[float, ...] = ()
    """k1 k2 p1 p2 [k3] of a video; undone once"""
    fps: float | None = None
    """instead of the source's"""
    count: int = 100
    """training pictures of a video: the sharpest of each pose"""
    up: Up | None = None
    """the source's axis that points up, where the poses do not tell"""
    choice: tyro.conf.OmitArgPrefixes[Choice] = field(default_factory=Choice)
