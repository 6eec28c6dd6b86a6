"""Output of ``rnd-data check``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rnd_runtime.cli.command import finish, show
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.files import write_json

from .check import CheckReport, check_capture
from .overlay import save_overlay


def check_and_report(capture: Path, out: Path) -> int:
    """Check ``capture``, print the findings and write them into ``out``; returns the exit code."""
    with Progress() as progress:
        progress.phase("checking")
        report = check_capture(capture, on_frame=lambda done, total: progress.update(done, step=f"{done}/{total}"))
    try:
        save_report(report, out)
    finally:  # even if they cannot be saved
        for finding in report.findings:
            show(f"{finding.level:>5} {finding.subject}: {finding.sentence}")
    then = None if report.wrong else f"rnd-train {capture} --out runs/{report.capture.folder.resolve().name}"
    finish(out / "check.png", "overlay of masks and template", then=then)
    return 1 if report.wrong else 0


def save_report(report: CheckReport, out: Path) -> None:
    """Write ``check.json`` and ``check.png`` into ``out``."""
    save_overlay(out / "check.png", report)
    record = {
        "mean_iou": report.mean_iou,
        "findings": [dataclasses.asdict(finding) for finding in report.findings],
        "frames": [dataclasses.asdict(entry) for entry in report.ious],
    }
    write_json(out / "check.json", record)
