"""Output of ``rnd-data import``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rnd_runtime.cli.command import show
from rnd_runtime.cli.progress import Progress
from rnd_trainer.checking.report import check_and_report

from .importer import import_source
from .options import ImportOptions
from .scene import PlacedScene


def import_and_report(
    source: Path, out: Path, options: ImportOptions, importer: Callable[..., PlacedScene] = import_source
) -> int:
    """Import, print findings and assumptions, check the result; returns the exit code.

    ``importer`` is called as ``import_source`` is.
    """
    with Progress() as progress:
        on_found = lambda sentence: show(f"found {sentence}")  # noqa: E731
        scene = importer(source, out, options, on_progress=progress.at, on_found=on_found)
    for note in scene.notes:
        show(f" note {note}")
    return check_and_report(out, out / "check")
