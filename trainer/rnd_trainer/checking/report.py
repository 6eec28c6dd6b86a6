"""The check as a command shows it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from rnd_runtime.core.files import write_json

from .check import Report, check_capture
from .overlay import save_overlay

_MARKS = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "wrong": "[red]wrong[/]"}


def passing_progress() -> Progress:
    """Bars that are taken away at the end; none where nobody sees them go, and an empty line would be left."""
    console = Console(stderr=True)
    return Progress(console=console, transient=True, disable=not console.is_terminal)


def check_and_report(capture: Path, out: Path) -> int:
    """Check ``capture``, print the findings, write ``check.json`` and ``check.png`` into ``out``; 1 when wrong."""
    with passing_progress() as progress:
        task = progress.add_task("checking")
        report = check_capture(capture, on_frame=lambda done, total: progress.update(task, completed=done, total=total))
    try:
        save_report(report, out)
    finally:  # shown where they cannot be saved, and saved where nobody reads them
        _show(report)
    Console(emoji=False).print(f"      overlay: {escape(str(out / 'check.png'))}", soft_wrap=True)
    return 1 if report.wrong else 0


def _show(report: Report) -> None:
    console = Console(emoji=False)
    for finding in report.findings:
        console.print(f"{_MARKS[finding.level]:>5} {finding.subject}: {escape(finding.sentence)}", soft_wrap=True)


def save_report(report: Report, out: Path) -> None:
    """Write ``check.json`` and ``check.png`` into ``out``."""
    save_overlay(out / "check.png", report)
    record = {
        "mean_iou": report.mean_iou,
        "findings": [dataclasses.asdict(finding) for finding in report.findings],
        "frames": [dataclasses.asdict(entry) for entry in report.overlaps],
    }
    write_json(out / "check.json", record)
