"""The time of a call, repeated, and what is told of many times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

REPEATS = 15
SECONDS = 0.5
"""calls go on until both are reached: short ones want more of them"""
WARMUP = 2


def times(run: Callable[[], Any]) -> dict[str, float]:
    """Median, 95th percentile and least milliseconds of a call."""
    return by_turns([run])[0]


def by_turns(runs: Sequence[Callable[[], Any]]) -> list[dict[str, float]]:
    """``times`` of several calls that take turns, so that a busy moment slows all of them."""
    taken: list[list[float]] = [[] for _ in runs]
    until = perf_counter() + SECONDS * len(runs)
    while len(taken[0]) < WARMUP + REPEATS or perf_counter() < until:
        for run, mine in zip(runs, taken):
            start = perf_counter()
            run()
            mine.append(1e3 * (perf_counter() - start))
    return [summary(mine[WARMUP:]) for mine in taken]


def summary(taken: Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and least of milliseconds, as rows name them."""
    return {
        "ms_median": float(np.median(taken)),
        "ms_p95": float(np.percentile(taken, 95)),
        "ms_min": float(np.min(taken)),
    }
