"""Seconds of each stage of a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.table import Table

from rnd_runtime.cli.command import is_quiet


class StageTimes:
    """Seconds spent in named stages, in the order in which the stages were first met."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block as one run of stage ``name``."""
        started = time.perf_counter()
        yield
        self.add(name, time.perf_counter() - started)

    def add(self, name: str, seconds: float) -> None:
        """Record one run of stage ``name`` that was timed elsewhere."""
        self.seconds.setdefault(name, []).append(seconds)

    def extend(self, seconds: Mapping[str, Sequence[float]]) -> None:
        """Record the runs of stages that another process timed."""
        for name, runs in seconds.items():
            self.seconds.setdefault(name, []).extend(runs)

    def summary(self) -> dict[str, dict[str, float]]:
        """``{stage: {"runs", "median_ms", "p95_ms", "total_s"}}``."""
        return {
            name: {
                "runs": len(runs),
                "median_ms": round(1e3 * float(np.median(runs)), 3),
                "p95_ms": round(1e3 * float(np.percentile(runs, 95)), 3),
                "total_s": round(sum(runs), 4),
            }
            for name, runs in self.seconds.items()
        }


def show_times(summary: Mapping[str, Mapping[str, float]]) -> None:
    """Print a table of ``StageTimes.summary``; nothing under ``--quiet``."""
    table = Table("stage", box=None, pad_edge=False)
    for heading in ("median ms", "p95 ms", "total s"):
        table.add_column(heading, justify="right")
    for name, row in summary.items():
        table.add_row(name, f"{row['median_ms']:.1f}", f"{row['p95_ms']:.1f}", f"{row['total_s']:.2f}")
    Console(quiet=is_quiet()).print(table)
