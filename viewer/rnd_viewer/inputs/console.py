"""What ``rnd-play`` says: progress and warnings on stderr, the summary on stdout."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rnd_runtime.core.console import print_plain
from rnd_runtime.playback.doctor import Finding

FRAME = "frame to frame"
LATENCY = "pose to pixels"
_stderr = Console(stderr=True)


def say(line: str) -> None:
    """One plain line on stdout."""
    print_plain(Console(), line)


def warn(message: str) -> None:
    """One warning line on stderr."""
    print_plain(_stderr, f"rnd-play: warning: {message}")


def tell(line: str) -> None:
    """One line on stderr that is no warning."""
    print_plain(_stderr, f"rnd-play: {line}")


def with_progress(frames: range, done: Iterable[int]) -> Iterable[int]:
    """``done``, numbers out of ``frames``, with a bar and the time left on stderr where that is a terminal."""
    with Progress(
        TextColumn("rendering"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=_stderr,
        disable=not _stderr.is_terminal,
    ) as progress:
        yield from progress.track(done, total=len(frames))


def print_summary(summary: dict[str, dict[str, float]], *, headline: str) -> None:
    """The table of ``StageTimes.summary``, then one line that says what was made and how fast."""
    table = Table("stage", box=None, pad_edge=False)
    for heading in ("median ms", "p95 ms", "total s"):
        table.add_column(heading, justify="right")
    for name, row in summary.items():
        table.add_row(name, f"{row['median_ms']:.1f}", f"{row['p95_ms']:.1f}", f"{row['total_s']:.2f}")
    console = Console()
    console.print(table)
    print_plain(console, headline)


def print_findings(findings: Iterable[Finding]) -> None:
    """What the doctor found: one line each, and below it what to do where something can be done."""
    console = Console()
    for finding in findings:
        lines = [f"{finding.label:<14} {finding.value}"]
        if finding.advice is not None:
            lines.append(f"{'':<14} → {finding.advice}")
        print_plain(console, "\n".join(lines))
