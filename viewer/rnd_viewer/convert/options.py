"""Options of ``rnd-convert``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import File, Folder, Number, OptionalFile, OptionalNumber, option
from rnd_runtime.core.errors import check_option, refuse_changed, refuse_outside
from rnd_runtime.motion.readers.arrays import FPS_LIMITS
from rnd_viewer.inputs.options import MotionGroup, MotionOptions, ProbeUp


@dataclass(frozen=True)
class SplatOptions:
    """Write posed, relit frames as plain 3D Gaussians.

    rnd-convert splats avatar.onnx --motion walk.npz --hdr sky.exr --frames 10:12 --format ply,glb --out out/splats
    """

    avatar: Annotated[tyro.conf.Positional[Path], option("AVATAR.onnx")]
    """The avatar, a file of rnd-export."""
    motion: File
    """Body poses over time, in any format of rnd-play."""
    out: Folder
    """Folder for 000000.ply and so on."""
    format: Annotated[str, option("LIST")] = "ply"
    """Some of ply,glb,spz,sog (the last two by splat-transform) and visionary (all frames in one visionary.onnx)."""
    frames: Annotated[str, option("START:END")] = "0:1"
    """Frames of the motion, END excluded; either may be missing."""
    colour: Annotated[Literal["lit", "albedo"], option("lit|albedo")] = "lit"
    """Shaded by the light, or the material's own colour."""
    hdr: OptionalFile = None
    """Light probe, lat-long EXR or HDR. Default: the light of the avatar's capture."""
    hdr_up: ProbeUp = "y"
    """Up axis of the probe's file."""
    hdr_yaw: Number = 0.0
    """Rotation of the light, degrees."""
    exposure: Number = 0.0
    """Stops that brighten the light."""
    shade: Annotated[str, option("MODE")] = "table+sun"
    """Shading, as of rnd-play."""
    camera: Annotated[str, option("front|FILE.json[:NAME]")] = "front"
    """View direction of the highlights for --sh-degree 0."""
    sh_degree: Annotated[Literal[0, 1, 2, 3], option("0|1|2|3")] = 0
    """Degree of the view-dependent colour, fitted over all directions."""
    coding: Annotated[Literal["srgb", "linear"], option("srgb|linear")] = "srgb"
    """srgb for viewers that show colours as they are; linear radiance for renderers that code the blended image."""
    ply_axes: Annotated[Literal["3dgs", "y-up"], option("3dgs|y-up")] = "3dgs"
    """Axes of .ply, .spz and .sog. 3dgs: Y down, rotated by 180° about Z, as their viewers expect. A .glb is Y up."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def __post_init__(self) -> None:
        if self.hdr is None:
            refuse_changed(self, ["hdr_up"], "needs --hdr")
        refuse_outside(self, {"exposure": (-30, 30), "hdr_yaw": (-1e6, 1e6)})

    def refuse_unfit(self, formats: Sequence[str]) -> None:
        """Refuse options that files in ``formats`` cannot follow, with an ``InputError``."""
        if self.colour == "albedo":
            lit = ("hdr", "hdr_yaw", "hdr_up", "exposure", "shade", "camera", "sh_degree")
            refuse_changed(self, lit, "--colour albedo is independent of light and view")
        if self.sh_degree > 0:
            refuse_changed(self, ["camera"], "--sh-degree above 0 is fitted over all directions")
        if set(formats) == {"glb"}:
            refuse_changed(self, ["ply_axes"], "a .glb is always Y up")
        if "visionary" in formats:
            check_option(self.sh_degree == 0, "--sh-degree", "0 for visionary", self.sh_degree)
            check_option(self.coding == "srgb", "--coding", "srgb for visionary", self.coding)


@dataclass(frozen=True)
class MeshOptions:
    """Write the posed template: one .glb with skeleton, weights and the whole motion, or an .obj a frame.

    rnd-convert mesh body.npz --motion walk.npz --format glb,obj --frames 0:10 --out out/mesh
    """

    body: Annotated[tyro.conf.Positional[Path], option("FILE")]
    """body.npz, as in a capture's folder; an avatar holds Gaussians and no mesh."""
    motion: File
    """Body poses over time, in any format of rnd-play."""
    out: Folder
    """Folder for body.glb, 000000.obj and so on."""
    format: Annotated[str, option("LIST")] = "glb"
    """Some of glb,obj."""
    frames: Annotated[str, option("START:END")] = "0:1"
    """Frames to write as .obj, END excluded; either may be missing."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def refuse_unfit(self, formats: Sequence[str]) -> None:
        """Refuse options that files in ``formats`` cannot follow, with an ``InputError``."""
        if "obj" not in formats:
            refuse_changed(self, ["frames"], "a .glb has the whole motion")


@dataclass(frozen=True)
class AmassOptions:
    """Write a motion as an AMASS .npz (SMPL-H, Z up), which SMPL tools read.

    rnd-convert motion avatar.onnx --motion run.bvh --out run.npz
    """

    skeleton: Annotated[tyro.conf.Positional[Path], option("FILE")]
    """avatar.onnx or body.npz: the skeleton of the motion."""
    motion: File
    """Body poses over time, in any format of rnd-play."""
    out: File
    """The .npz to write."""
    fps: OptionalNumber = None
    """Frames per second to write. Default: the motion's."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def __post_init__(self) -> None:
        refuse_outside(self, {"fps": FPS_LIMITS})


Options = SplatOptions | MeshOptions | AmassOptions
COMMANDS: dict[str, type[Options]] = {"splats": SplatOptions, "mesh": MeshOptions, "motion": AmassOptions}
