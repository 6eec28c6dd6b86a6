"""Seconds of each stage of a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


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
