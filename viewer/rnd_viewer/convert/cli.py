"""The command ``rnd-convert``: avatars, bodies and motions in the formats of other tools."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.core.errors import check_option, parse_options, refuse_changed, run_command
from rnd_viewer.inputs.options import LitOptions, MotionOptions

_NO_HINT = tyro.conf.arg(help_behavior_hint="")


@dataclass(frozen=True)
class SplatOptions(LitOptions):
    """Posed, relit frames as plain 3D Gaussians: .ply and .glb, and .spz or .sog where splat-transform is installed."""

    avatar: Annotated[Path, tyro.conf.Positional]
    """avatar.onnx"""
    motion: Path
    """body poses over time"""
    out: Path
    """folder for 000000.ply and so on"""
    format: str = "ply"
    """some of ply,glb,spz,sog and visionary (all frames in one visionary.onnx)"""
    frames: str = "0:1"
    """frames of the motion, START:END, END excluded, either may be missing"""
    colour: Literal["lit", "albedo"] = "lit"
    """shaded by the light, or the material's own colour"""
    hdr: Annotated[Path | None, _NO_HINT] = None
    """light probe, lat-long EXR or HDR. Default: the light the avatar was captured under"""
    hdr_yaw: float = 0.0
    """turn the light, degrees"""
    exposure: float = 0.0
    """stops by which the light is made brighter"""
    shade: str = "table+sun"
    """shading, as of rnd-play"""
    camera: str = "front"
    """front, FILE.json or FILE.json:NAME: from where highlights are seen when --sh-degree is 0"""
    sh_degree: Literal[0, 1, 2, 3] = 0
    """above 0: the colour's change with the view, fitted from all around"""
    coding: Literal["srgb", "linear"] = "srgb"
    """srgb: what viewers show as it is. linear: radiance, for renderers that code the blended picture"""
    ply_axes: Literal["3dgs", "y-up"] = "3dgs"
    """3dgs: turned by 180° about Z, (x, y, z) to (-x, -y, z), so Y down, as viewers of .ply, .spz and .sog expect. The
    .glb is always Y up"""

    def refuse_unfit(self, formats: Sequence[str]) -> None:
        """Refuse options that files in ``formats`` cannot follow.

        Raises:
            InputError: naming the first.
        """
        if self.colour == "albedo":
            lit = ("hdr", "hdr_yaw", "hdr_up", "exposure", "shade", "camera", "sh_degree")
            refuse_changed(self, lit, "--colour albedo is the same under every light and from everywhere")
        if self.sh_degree > 0:
            refuse_changed(self, ["camera"], "--sh-degree above 0 looks from all around")
        if set(formats) == {"glb"}:
            refuse_changed(self, ["ply_axes"], "a .glb is always Y up")
        if "visionary" in formats:
            check_option(self.sh_degree == 0, "--sh-degree", "0 for visionary", self.sh_degree)
            check_option(self.coding == "srgb", "--coding", "srgb for visionary", self.coding)


@dataclass(frozen=True)
class MeshOptions(MotionOptions):
    """The posed template: .obj for each frame, or one .glb with skeleton, weights and the motion as an animation."""

    body: Annotated[Path, tyro.conf.Positional]
    """body.npz, as in a capture's folder (an avatar holds Gaussians, no mesh)"""
    motion: Path
    """body poses over time"""
    out: Path
    """folder for body.glb, 000000.obj and so on"""
    format: str = "glb"
    """some of glb,obj"""
    frames: str = "0:1"
    """frames to write as .obj, START:END, END excluded, either may be missing"""

    def refuse_unfit(self, formats: Sequence[str]) -> None:
        """Refuse options that files in ``formats`` cannot follow.

        Raises:
            InputError: naming the first.
        """
        if "obj" not in formats:
            refuse_changed(self, ["frames"], "a .glb has the whole motion")


@dataclass(frozen=True)
class AmassOptions(MotionOptions):
    """A motion as an AMASS .npz (SMPL-H, Z up), which SMPL tools for Blender and others read."""

    skeleton: Annotated[Path, tyro.conf.Positional]
    """avatar.onnx or body.npz: whose joints they are"""
    motion: Path
    """body poses over time, in any format that rnd-play reads"""
    out: Path
    """the .npz to write"""


Options = SplatOptions | MeshOptions | AmassOptions
_COMMANDS: dict[str, Callable[..., Options]] = {"splats": SplatOptions, "mesh": MeshOptions, "motion": AmassOptions}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-convert`` with ``arguments`` (the process's own when None) and return its exit code."""

    def command() -> int:
        options: Options = parse_options(
            lambda: tyro.extras.subcommand_cli_from_dict(_COMMANDS, prog="rnd-convert", args=arguments)
        )
        from rnd_viewer.inputs.console import say

        from .convert import convert  # here, so that --help needs no heavy library

        for line in convert(options):
            say(line)
        return 0

    return run_command("rnd-convert", command)
