"""Milliseconds of a frame on a machine that has other things to do."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

TIMED, UNTIMED = 12, 2
"""frames that are measured, and those before them that warm up"""


class Stopwatch:
    """Times a player beside a reference, frame by frame in turn, so that a busy moment slows both.

    Args:
        reference: draws frame k by what everything is compared with.
        clock: seconds.
    """

    def __init__(self, reference: Callable[[int], object], clock: Callable[[], float] = perf_counter) -> None:
        self._reference, self._clock = reference, clock
        self._calmest = np.inf

    def ms(self, draw: Callable[[int], object]) -> float:
        """What a frame of ``draw`` takes where the reference takes as little as it ever did here."""
        rounds = [(self._timed(draw, k), self._timed(self._reference, k)) for k in range(UNTIMED + TIMED)]
        ours, reference = np.array(rounds[UNTIMED:]).T
        self._calmest = min(self._calmest, float(np.sort(reference)[: TIMED // 2].mean()))
        return float(np.median(ours / reference)) * self._calmest

    def _timed(self, draw: Callable[[int], object], frame: int) -> float:
        started = self._clock()
        draw(frame)
        return 1e3 * (self._clock() - started)
