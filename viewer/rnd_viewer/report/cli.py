"""The command ``rnd-report``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.core.errors import InputError, check_option, flag, parse_options, run_command
from rnd_runtime.core.files import is_folder, output_file
from rnd_viewer.inputs.options import LitOptions

_NO_HINT = tyro.conf.arg(help_behavior_hint="")


@dataclass(frozen=True)
class ReportOptions(LitOptions):
    """One HTML page about a training: clip, relights, held-out scores, truth against render, losses, options."""

    run: Annotated[Path, tyro.conf.Positional]
    """folder of rnd-train"""
    out: Annotated[Path | None, _NO_HINT] = None
    """the page. Default: report.html in RUN"""
    motion: Annotated[Path | None, _NO_HINT] = None
    """body poses for the turntable. Default: the rest pose"""
    hdr: tuple[Path, ...] = ()
    """light probes to show the avatar under, beside the learned light"""
    bench: Annotated[Path | None, _NO_HINT] = None
    """folder with crossed.svg or grid.svg, and stability.json. Default: RUN/bench, else assets/bench if it is there"""
    pictures: int = 3
    """pictures of each held-out split"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-report`` with ``arguments`` (the process's own when None) and return its exit code."""

    def command() -> int:
        options = parse_options(lambda: tyro.cli(ReportOptions, prog="rnd-report", args=arguments))
        if options.pictures < 0:
            raise InputError("--pictures", expected="0 or more", got=options.pictures)
        if options.motion is None:
            options.refuse_unread("needs --motion: the rest pose does not move")
        if options.bench is not None and not is_folder(options.bench):
            raise InputError("folder of --bench not found", file=options.bench)
        from rnd_viewer.inputs.console import say

        from .bench import find_bench
        from .run_files import read_config
        from .run_report import why_no_avatar, write_run_report

        out = options.out or options.run / "report.html"
        check_option(out.suffix.lower() == ".html", "--out", "a name in .html", out)
        if why_not := why_no_avatar(options.run, read_config(options.run)):
            for name in ("motion", "hdr"):  # played and lit by the avatar alone
                if getattr(options, name):
                    raise InputError(flag(name), expected="an avatar that can be shown", hint=why_not)
        output_file(out)
        motion = None if options.motion is None else partial(options.read_motion, options.motion)
        notes = write_run_report(
            options.run,
            out,
            motion=motion,
            hdrs=options.hdr,
            hdr_up=options.hdr_up,
            bench=options.bench or find_bench(options.run),
            pictures=options.pictures,
        )
        for note in notes:
            say(f"note: {note}")
        say(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
        return 0

    return run_command("rnd-report", command)
