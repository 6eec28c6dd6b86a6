"""The import as a command shows it."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from rnd_trainer.checking.report import check_and_report, passing_progress

from .importer import import_source
from .options import ImportOptions


def import_and_report(source: Path, out: Path, options: ImportOptions) -> int:
    """Import, print what was found and assumed, check the result; 1 when the check finds something wrong."""
    console = Console()
    with passing_progress() as progress:
        task = progress.add_task("writing")
        scene = import_source(
            source,
            out,
            options,
            on_shot=lambda done, total: progress.update(task, completed=done, total=total),
            on_found=lambda sentence: console.print(f"found {escape(sentence)}", soft_wrap=True),
        )
    for note in scene.notes:
        console.print(f" note {escape(note)}", soft_wrap=True)
    return check_and_report(out, out / "check")
