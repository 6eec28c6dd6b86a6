"""Milliseconds of a frame on a machine that has other things to do."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

TIMED, UNTIMED = 12, 2
"""frames that are measured, and those before them that warm up"""
CALIBRATED = 36
"""frames of the reference alone, at first, whose calmest sixth says what it takes"""
CALMER = 0.1
"""share of a frame's time"""


def milliseconds(
    draw: Callable[[int], object], count: int, clock: Callable[[], float] = perf_counter
) -> NDArray[np.float64]:
    """What each of ``count`` frames of ``draw`` takes [count], after ``UNTIMED`` that warm up."""
    return np.array([_timed(draw, frame, clock) for frame in range(UNTIMED + count)][UNTIMED:])


def _timed(draw: Callable[[int], object], frame: int, clock: Callable[[], float]) -> float:
    started = clock()
    draw(frame)
    return 1e3 * (clock() - started)


class Stopwatch:
    """Times a player beside a reference, frame by frame in turn, so that a busy moment slows both.

    What is told in milliseconds is a ratio to the reference, times what that took in its calmest moments at the start,
    or before ``recalibrated``: one number for all that is timed, so that it can be compared whenever it was.

    Args:
        reference: draws frame k by what everything is compared with.
        clock: seconds.
    """

    def __init__(self, reference: Callable[[int], object], clock: Callable[[], float] = perf_counter) -> None:
        self._reference, self._clock = reference, clock
        self._taken = list(milliseconds(reference, CALIBRATED, clock))
        self._calm = self._calmest()

    def ms(self, draw: Callable[[int], object]) -> float:
        """What a frame of ``draw`` takes where the reference takes as little as in its calmest moments."""
        both = (draw, self._reference)
        rounds = [[_timed(drawn, k, self._clock) for drawn in both] for k in range(UNTIMED + TIMED)]
        ours, reference = np.array(rounds[UNTIMED:]).T
        self._taken.extend(reference)
        return float(np.median(ours / reference)) * self._calm

    def recalibrated(self) -> bool:
        """Whether the machine has been calmer since by more than ``CALMER``: from now on that counts.

        What was told before cannot be compared with what is told then.
        """
        calmest = self._calmest()
        calmer = calmest < (1 - CALMER) * self._calm
        if calmer:
            self._calm = calmest
        return calmer

    def _calmest(self) -> float:
        return float(np.sort(self._taken)[: CALIBRATED // 6].mean())
