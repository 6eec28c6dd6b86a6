"""Options of ``rnd-data import``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

from rnd_runtime.cli.command import OptionalCount, OptionalFile, OptionalFolder, OptionalNumber, group, option

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
OnProgress = Callable[[str, int, int], None]
"""called with (phase, done, total)"""


def no_progress(phase: str, done: int, total: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class FrameSelection:
    """Which images become part of the capture."""

    train_camera: Annotated[str | None, option("NAME")] = None
    """Camera whose first 4/5 train. Default: the first."""
    held_out_every: int = 30
    """Interval of novel views of the other cameras, frames."""
    every: int = 1
    """Keep frames whose number is a multiple of this."""
    start: int = 0
    """First frame number to keep."""
    stop: OptionalCount = None
    """Frame number to stop before."""

    def keeps(self, frame: int) -> bool:
        """Whether the frame of this number may be taken."""
        return self.start <= frame < (frame + 1 if self.stop is None else self.stop) and frame % self.every == 0


@dataclass(frozen=True)
class ImportOptions:
    """How to read a source, and what to take of it."""

    body: Annotated[str | None, option("FILE|anny")] = None
    """SMPL, SMPL-H or SMPL-X (.npz or .pkl), a body.npz, or the word anny. Default, of a video: estimated."""
    layout: Annotated[str | None, option("LAYOUT", name="as")] = None
    """Layout of SOURCE, such as zju, nerfstudio or video. Default: detected."""
    root: Annotated[Literal["smpl", "easymocap"] | None, option("smpl|easymocap")] = None
    """Root convention of the poses. Default: the layout's."""
    poses: OptionalFile = None
    """Body poses of WHAM, GVHMR, 4D-Humans, ROMP, EasyMocap, SAM 3D Body, GEM-X, TRAM, PromptHMR or SLAHMR,
    or an SMPL .npz. Default, of a video: estimated."""
    person: OptionalCount = None
    """Track number in --poses (default: the longest track); without them, the person, counted from the left from 0."""
    masks: OptionalFolder = None
    """Masks (.png, .npy) by name or number of the frames, a folder per camera. Default: the source's, or estimated."""
    mask_net: OptionalFile = None
    """Segmentation network (.onnx) for the masks."""
    normals: OptionalFolder = None
    """Normal maps (.npy, .png), named as masks. Default: the source's."""
    normal_net: OptionalFile = None
    """Normal network (.onnx) for the normals."""
    normal_axes: Annotated[str | None, option("AXES")] = None
    """The maps' axes that are right, down, forward, such as x,-y,-z. Default: found by the template."""
    albedos: OptionalFolder = None
    """Estimated base colours (.png, .jpg), named as masks: a soft target of training."""
    albedo_net: OptionalFile = None
    """Albedo or de-lighting network (.onnx) for the albedos."""
    height: OptionalNumber = None
    """The person's height in metres, of a video without --poses: fixes the scale."""
    intrinsics: Annotated[tuple[float, ...], option("N N N N")] = ()
    """fx fy cx cy of a video, in pixels."""
    distortion: Annotated[tuple[float, ...], option("N ...")] = ()
    """k1 k2 p1 p2 [k3] of a video; undone once."""
    fps: OptionalNumber = None
    """Frames per second. Default: the source's."""
    count: int = 100
    """Training images of a video: the sharpest of each pose."""
    up: Annotated[Up | None, option("AXIS")] = None
    """Up axis of the source: x, -x, y, -y, z or -z. Default: found by the poses."""
    selection: Annotated[FrameSelection, *group("frames")] = field(default_factory=FrameSelection)
