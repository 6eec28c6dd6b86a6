"""Options of ``rnd-convert``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import File, Flag, Folder, Number, OptionalFile, OptionalNumber, OptionalSize, option
from rnd_runtime.core.errors import InputError, check_option, refuse_changed, refuse_outside
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
    """Some of ply,glb,spz,sog (the last two by splat-transform), and of all frames in one file: visionary
    (visionary.onnx) and usd (splats.usdc with time samples)."""
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
    material: Flag = False
    """Add albedo, roughness and ambient visibility to a .ply, so that other renderers can relight it."""
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
        if "ply" not in formats:
            refuse_changed(self, ["material"], "only a .ply has more properties")
        if "visionary" in formats:
            check_option(self.sh_degree == 0, "--sh-degree", "0 for visionary", self.sh_degree)
            check_option(self.coding == "srgb", "--coding", "srgb for visionary", self.coding)


@dataclass(frozen=True)
class MeshOptions:
    """Write the clothed surface, textured and rigged: one .glb or .usdz with the whole motion, or an .obj a frame.

    rnd-convert mesh avatar.onnx --body body.npz --motion walk.npz --format glb,obj --frames 0:10 --out out/mesh
    """

    avatar: Annotated[tyro.conf.Positional[Path], option("AVATAR.onnx")]
    """The avatar, a file of rnd-export."""
    body: File
    """body.npz of the capture that the avatar was trained on: the mesh that is moved onto its Gaussians."""
    motion: File
    """Body poses over time, in any format of rnd-play."""
    out: Folder
    """Folder for avatar.glb, avatar.usdz, 000000.obj and so on."""
    format: Annotated[str, option("LIST")] = "glb"
    """Some of glb,usd,obj. An .obj is posed as the avatar itself; the others have four joints a vertex."""
    frames: Annotated[str, option("START:END")] = "0:1"
    """Frames to write as .obj, END excluded; either may be missing."""
    texture: Annotated[int, option("N")] = 1024
    """Side of the textures in pixels."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def __post_init__(self) -> None:
        refuse_outside(self, {"texture": (64, 8192)})

    def refuse_unfit(self, formats: Sequence[str]) -> None:
        """Refuse options that files in ``formats`` cannot follow, with an ``InputError``."""
        if "obj" not in formats:
            refuse_changed(self, ["frames"], "a .glb or .usdz has the whole motion")


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


@dataclass(frozen=True)
class CameraOptions:
    """Write cameras of other programs as a file for rnd-play's --camera.

    rnd-convert camera shot.glb --size 1920x1080 --out camera.json
    """

    source: Annotated[tyro.conf.Positional[Path], option("FILE")]
    """nerfstudio's transforms.json, or a .gltf, .glb, .usd, .usda, .usdc or .usdz, as Blender writes them."""
    out: File
    """The .json to write."""
    name: Annotated[str | None, option("NAME")] = None
    """Camera of a file that holds several."""
    size: OptionalSize = None
    """Size of a frame in pixels, for files that have none. Default: 1920x1080."""
    fps: OptionalNumber = None
    """Frames per second at which an animated camera of a .glb is sampled. Default: 30."""

    def __post_init__(self) -> None:
        refuse_outside(self, {"fps": FPS_LIMITS})


Options = SplatOptions | MeshOptions | AmassOptions | CameraOptions
COMMANDS: dict[str, type[Options]] = {
    "splats": SplatOptions,
    "mesh": MeshOptions,
    "motion": AmassOptions,
    "camera": CameraOptions,
}


def chosen_formats(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    """``ply,glb`` → names in the order of ``known``."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or names - set(known):
        raise InputError("--format", expected=f"some of {','.join(known)}", got=text or "nothing")
    return tuple(name for name in known if name in names)
