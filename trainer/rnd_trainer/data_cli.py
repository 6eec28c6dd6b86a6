"""rnd-data: captures from what people have, and checks of what came out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rnd_runtime.errors import run_command

from .eval_cli import need_extra
from .importing.options import ImportOptions
from .motion_cli import motion


@dataclass(frozen=True)
class ImportCommand:
    """Turn what you have into a capture: a data set, or a video with body poses. What it is is found out, and told."""

    source: Annotated[Path, tyro.conf.Positional]
    """a data set's folder for one subject, a video, or a folder of frames"""
    out: Annotated[Path, tyro.conf.Positional]
    """folder for the capture"""
    reading: tyro.conf.OmitArgPrefixes[ImportOptions] = field(default_factory=ImportOptions)


def import_source(command: ImportCommand) -> int:
    """Run the import, then the check."""
    need_extra()
    from .importing.report import import_and_report

    return import_and_report(command.source, command.out, command.reading)


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
