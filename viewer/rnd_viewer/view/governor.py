"""Control of the frame rate by the resolution."""

from __future__ import annotations

import numpy as np

SCALES = (1.0, 0.75, 0.5)  # scales of width and height
_LOWER_WINDOW = 4  # frames whose median decides on a lower scale
_RAISE_WINDOW = 24  # frames that must all be fast before a higher scale
_HEADROOM = 0.6  # of the budget; the largest time of a fast frame


class ResolutionController:
    """Chooses a ``scale`` of ``SCALES`` from how long frames take.

    Args:
        fps: the rate to hold.
    """

    def __init__(self, fps: float) -> None:
        self._budget = 1 / fps
        self._level = 0
        self._seconds: list[float] = []

    @property
    def scale(self) -> float:
        return SCALES[self._level]

    def observe(self, seconds: float) -> None:
        """Add the time of the last frame."""
        self._seconds = [*self._seconds, seconds][-_RAISE_WINDOW:]
        if len(self._seconds) >= _LOWER_WINDOW and np.median(self._seconds[-_LOWER_WINDOW:]) > self._budget:
            self._change_level(1)
        elif len(self._seconds) == _RAISE_WINDOW and max(self._seconds) < _HEADROOM * self._budget:
            self._change_level(-1)

    def _change_level(self, step: int) -> None:
        self._level = min(max(self._level + step, 0), len(SCALES) - 1)
        self._seconds = []  # times of other scales do not count
