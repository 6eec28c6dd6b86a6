"""The import as a command shows it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from rnd_trainer.checking.report import check_and_report

from .importer import ImportOptions, import_source
from .write import Choice

if TYPE_CHECKING:
    from rnd_trainer.data_cli import ImportCommand


def import_and_report(command: ImportCommand) -> int:
    """Import, print what was found and assumed, check the result; 1 when the check finds something wrong."""
    console = Console()
    shared = {field.name for field in dataclasses.fields(ImportOptions)}
    given = {name: value for name, value in vars(command).items() if name in shared}
    choice = Choice(command.train_camera, command.held_out_every, command.every, command.start, command.stop)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("writing")
        scene = import_source(
            command.source, command.out, ImportOptions(**given, choice=choice),
            on_shot=lambda done, total: progress.update(task, completed=done, total=total),
            on_found=lambda sentence: console.print(f"found {escape(sentence)}", soft_wrap=True),
        )  # fmt: skip
    for note in scene.notes:
        console.print(f" note {escape(note)}", soft_wrap=True)
    return check_and_report(command.out, command.out / "check")
