"""rnd-data: captures from what people have, and checks of what came out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any

import tyro

from rnd_runtime.core.errors import parse_options, run_command
from rnd_runtime.core.files import is_folder
from rnd_trainer.importing.options import ImportOptions

from .eval import need_extra
from .motion import motion


def import_source(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    reading: Annotated[ImportOptions, tyro.conf.arg(name="")] = ImportOptions(),  # noqa: B008  # frozen
) -> int:
    """Turn what you have into a capture: a data set, or a video with body poses. What it is is found out, and told.

    Args:
        source: a data set's folder for one subject, a video, or a folder of frames
        out: folder for the capture
        reading: how it is to be understood
    """
    need_extra()
    from rnd_trainer.importing.report import import_and_report

    return import_and_report(source, out, reading)


def check(capture: Annotated[Path, tyro.conf.Positional], out: Path | None = None) -> int:
    """Check a capture against itself: units, cameras, masks, silhouettes, normals, timing. Exit 1: something is wrong.

    Args:
        capture: folder with capture.json, or that file
        out: folder for check.json (IoU of every frame) and check.png (overlay); CAPTURE/check when not given
    """
    need_extra()
    from rnd_trainer.checking.report import check_and_report

    folder = capture if is_folder(capture) else capture.parent
    return check_and_report(capture, folder / "check" if out is None else out)


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
    from rnd_trainer.importing.body_models import convert_body_model

    print(convert_body_model(model, out, betas, license))  # noqa: T201


COMMANDS: dict[str, Callable[..., Any]] = {
    "import": import_source,
    "check": check,
    "convert-body": convert_body,
    "motion": motion,
}


def _not_yet(command: Callable[..., Any]) -> Callable[..., Any]:
    """``command`` as tyro sees it, but what it does when called is left to the call of what it returns."""

    @wraps(command)
    def chosen(*args: Any, **options: Any) -> Callable[[], Any]:
        return partial(command, *args, **options)

    return chosen


def main() -> None:
    """Entry point of ``rnd-data``."""

    later = {name: _not_yet(function) for name, function in COMMANDS.items()}

    def command() -> int | None:
        chosen = parse_options(lambda: tyro.extras.subcommand_cli_from_dict(later, prog="rnd-data"))
        result: int | None = chosen()
        return result

    sys.exit(run_command("rnd-data", command))


if __name__ == "__main__":
    main()
