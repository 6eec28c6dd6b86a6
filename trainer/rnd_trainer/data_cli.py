"""rnd-data: captures from what people have, and checks of what came out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rnd_runtime.errors import run_command

from .eval_cli import need_extra
from .motion_cli import motion

Up = Literal["x", "-x", "y", "-y", "z", "-z"]


@dataclass(frozen=True)
class ImportCommand:
    """Turn what you have into a capture: a data set, or a video with body poses. What it is is found out, and told."""

    source: Annotated[Path, tyro.conf.Positional]
    """a data set's folder for one subject, a video, or a folder of frames"""
    out: Annotated[Path, tyro.conf.Positional]
    """folder for the capture"""
    body: str | None = None
    """SMPL, SMPL-H or SMPL-X (.npz or .pkl), a body.npz, or the word anny"""
    layout: Annotated[str | None, tyro.conf.arg(name="as")] = None
    """what SOURCE is, where it is not found out rightly; smpl or easymocap: how the root of the poses is meant"""
    poses: Path | None = None
    """body poses from WHAM, GVHMR, 4D-Humans, ROMP, EasyMocap or an SMPL .npz"""
    person: int | None = None
    """track number in --poses"""
    masks: Path | None = None
    """folder of masks (.png, .npy), numbered like the frames; without one, rough masks are made"""
    mask_net: Path | None = None
    """segmentation network (.onnx) to make masks with, instead of the source's"""
    normals: Path | None = None
    """folder of normal maps (.npy, .png), numbered like the frames"""
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


def import_source(command: ImportCommand) -> int:
    """Run the import, then the check."""
    need_extra()
    from .importing.report import import_and_report

    return import_and_report(command)


def check(capture: Annotated[Path, tyro.conf.Positional], out: Path | None = None) -> int:
    """Check a capture against itself: units, cameras, masks, silhouettes, normals, timing. Exit 1: something is wrong.

    Args:
        capture: folder with capture.json
        out: folder for check.json (IoU of every frame) and check.png (overlay); CAPTURE/check when not given
    """
    need_extra()
    from .checking.report import check_and_report

    return check_and_report(capture, capture / "check" if out is None else out)


def convert_body(
    model: Annotated[str, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    betas: tuple[float, ...] = (),
    license: str | None = None,
) -> None:
    """Turn a body model (SMPL, SMPL-H, SMPL-X as .npz or .pkl, or the word anny) into a body.npz.

    Args:
        model: the file; a pickle is read without executing anything
        out: the body.npz to write
        betas: shape parameters, the first of them; the rest are 0
        license: what to write into the file about who may pass it on
    """
    need_extra()
    from .importing.body_models import convert_body_model

    print(convert_body_model(model, out, betas, license))  # noqa: T201


COMMANDS: dict[str, Callable[..., Any]] = {
    "import": ImportCommand,
    "check": check,
    "convert-body": convert_body,
    "motion": motion,
}


def main() -> None:
    """Entry point of ``rnd-data``."""

    def command() -> int | None:
        chosen = tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="rnd-data")
        result: int | None = import_source(chosen) if isinstance(chosen, ImportCommand) else chosen
        return result

    sys.exit(run_command("rnd-data", command))


if __name__ == "__main__":
    main()
