"""Holding a frame rate: what to give up, in which order, before a frame would be dropped.

Where shading is a step of its own, it is given up first: a Gaussian's radiance changes slowly from frame to frame. Then
resolution: the picture keeps its size and loses detail. Where a frame is drawn at once, by tables or on a device,
shading is too small a part of it for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]

_WINDOW = 4  # frames whose median decides to give something up: one slow frame does not
_CALM = 24  # frames that must all have had room before something is taken back
_ROOM = 0.6  # of the budget: what is taken back costs up to as much again


class Quality(NamedTuple):
    """How a frame is rendered: every how many frames it is shaded anew, and its side's share of the full resolution."""

    shade_every: int = 1
    scale: float = 1.0


FULL = Quality()
LADDER = (FULL, Quality(2), Quality(4), Quality(4, 0.75), Quality(4, 0.5))
LADDER_AT_ONCE = (FULL, Quality(1, 0.75), Quality(1, 0.5))
"""for frames that are drawn at once"""


class Governor:
    """Chooses a ``Quality`` from how long frames take.

    Args:
        fps: the rate to hold.
        ladder: what it chooses among, the best first.
    """

    def __init__(self, fps: float, ladder: Sequence[Quality] = LADDER) -> None:
        self._budget, self._ladder = 1 / fps, ladder
        self._level = 0
        self._seconds: list[float] = []

    @property
    def quality(self) -> Quality:
        return self._ladder[self._level]

    def observe(self, seconds: float) -> None:
        """Tell how long the last frame took to render."""
        self._seconds = [*self._seconds, seconds][-_CALM:]
        if len(self._seconds) >= _WINDOW and np.median(self._seconds[-_WINDOW:]) > self._budget:
            self._go(1)
        elif len(self._seconds) == _CALM and max(self._seconds) < _ROOM * self._budget:
            self._go(-1)

    def _go(self, step: int) -> None:
        self._level = min(max(self._level + step, 0), len(self._ladder) - 1)
        self._seconds = []  # what frames of another quality took says nothing of this one


def enlarged(picture: Floats32, height: int, width: int) -> Floats32:
    """``picture`` [h, w, C] at ``height`` × ``width``, bilinear between pixel centres."""
    result = np.empty((height, width, picture.shape[2]), np.float32)
    _enlarge(np.ascontiguousarray(picture, np.float32), result)
    return result


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _enlarge(picture, result):
    height, width, channels = picture.shape
    for y in prange(len(result)):
        row = min(max((y + 0.5) * height / len(result) - 0.5, 0.0), height - 1.0)
        top = int(row)
        below, t = min(top + 1, height - 1), np.float32(row - top)
        for x in range(result.shape[1]):
            column = min(max((x + 0.5) * width / result.shape[1] - 0.5, 0.0), width - 1.0)
            left = int(column)
            right, s = min(left + 1, width - 1), np.float32(column - left)
            for c in range(channels):
                upper = picture[top, left, c] + s * (picture[top, right, c] - picture[top, left, c])
                lower = picture[below, left, c] + s * (picture[below, right, c] - picture[below, left, c])
                result[y, x, c] = upper + t * (lower - upper)
