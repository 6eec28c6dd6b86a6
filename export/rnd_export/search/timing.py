"""Milliseconds of a frame on a machine with other load."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

TIMED, UNTIMED = 12, 2  # measured frames, and warm-up frames before them
CALIBRATED = 36  # frames of the reference at the start; the mean of the fastest sixth is its time
RECALIBRATION_GAIN = 0.1  # share by which the reference must become faster to be calibrated again


def milliseconds(
    draw: Callable[[int], object], count: int, clock: Callable[[], float] = perf_counter
) -> NDArray[np.float64]:
    """Times [count] of frames of ``draw``, ms, after ``UNTIMED`` warm-up frames."""
    return np.array([_timed(draw, frame, clock) for frame in range(UNTIMED + count)][UNTIMED:])


def _timed(draw: Callable[[int], object], frame: int, clock: Callable[[], float]) -> float:
    started = clock()
    draw(frame)
    return 1e3 * (clock() - started)


class PairedTimer:
    """Times of a player that alternates with a reference, so that other load slows both.

    A time is the ratio to the reference, times the reference's time on the idle machine: times of one calibration are
    comparable.

    Args:
        reference: renders frame k of the reference.
        clock: in seconds.
    """

    def __init__(self, reference: Callable[[int], object], clock: Callable[[], float] = perf_counter) -> None:
        self._reference, self._clock = reference, clock
        self._taken = list(milliseconds(reference, CALIBRATED, clock))
        self._idle_ms = self._fastest()

    def ms(self, draw: Callable[[int], object]) -> float:
        """Time of a frame of ``draw`` on the idle machine."""
        both = (draw, self._reference)
        rounds = [[_timed(draw, k, self._clock) for draw in both] for k in range(UNTIMED + TIMED)]
        times, reference = np.array(rounds[UNTIMED:]).T
        self._taken.extend(reference)
        return float(np.median(times / reference)) * self._idle_ms

    def recalibrated(self) -> bool:
        """Calibrate again if the machine was busy at the start; if True, earlier times are not comparable."""
        fastest = self._fastest()
        faster = fastest < (1 - RECALIBRATION_GAIN) * self._idle_ms
        if faster:
            self._idle_ms = fastest
        return faster

    def _fastest(self) -> float:
        return float(np.sort(self._taken)[: CALIBRATED // 6].mean())
