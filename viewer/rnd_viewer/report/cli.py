"""The command ``rnd-report``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import Count, Files, OptionalFile, OptionalFolder, finish, option, parse, run_command, warn
from rnd_runtime.core.errors import InputError, check_option, flag, refuse_changed
from rnd_runtime.core.files import is_folder, output_file
from rnd_viewer.inputs.options import MotionGroup, MotionOptions, ProbeUp


@dataclass(frozen=True)
class ReportOptions:
    """One HTML page about a training: clip, relights, held-out scores, truth against render, losses, options.

    rnd-report runs/me --motion walk.npz --hdr sky.exr
    """

    run: Annotated[tyro.conf.Positional[Path], option("RUN")]
    """Folder of rnd-train."""
    out: OptionalFile = None
    """The page. Default: report.html in RUN."""
    motion: OptionalFile = None
    """Body poses for the turntable. Default: the rest pose."""
    hdr: Files = ()
    """Light probes to show the avatar under, beside the learned light."""
    hdr_up: ProbeUp = "y"
    """Up axis of the probes' files."""
    bench: OptionalFolder = None
    """Folder of rnd-bench with crossed.svg or grid.svg, and stability.json: benchmarks of the software are added."""
    images: Count = 3
    """Images of each held-out split."""
    reading: MotionGroup = field(default_factory=MotionOptions)

    def __post_init__(self) -> None:
        if not self.hdr:
            refuse_changed(self, ["hdr_up"], "needs --hdr")
        check_option(self.images >= 0, "--images", "0 or more", self.images)
        if self.motion is None:
            self.reading.refuse_unread("needs --motion: the rest pose does not move")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-report`` with ``arguments`` (the process's own when None) and return its exit code."""
    return run_command("rnd-report", lambda: _report(parse(ReportOptions, "rnd-report", arguments)))


def _report(options: ReportOptions) -> int:
    from .run_files import read_config
    from .run_report import why_no_avatar, write_run_report

    if options.bench is not None and not is_folder(options.bench):
        raise InputError("folder of --bench not found", file=options.bench)
    out = options.out or options.run / "report.html"
    check_option(out.suffix.lower() == ".html", "--out", "a name in .html", out)
    if why_not := why_no_avatar(options.run, read_config(options.run)):
        for name in ("motion", "hdr"):  # played and lit by the avatar alone
            if getattr(options, name):
                raise InputError(flag(name), expected="an avatar that can be shown", hint=why_not)
    output_file(out)
    notes = write_run_report(
        options.run,
        out,
        motion=None if options.motion is None else partial(options.reading.read_motion, options.motion),
        hdrs=options.hdr,
        hdr_up=options.hdr_up,
        bench=options.bench,
        images=options.images,
    )
    for note in notes:
        warn(note)
    finish(out, f"{out.stat().st_size / 1e6:.1f} MB")
    return 0
