"""Images for comparison, and their PSNR."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.images import linear_to_srgb

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

IDENTICAL_DB = 200.0  # PSNR of equal images; JSON has no infinity


def srgb(linear: ArrayLike) -> Floats:
    """Linear radiance as sRGB in 0…1, not rounded."""
    return np.asarray(np.clip(linear_to_srgb(np.asarray(linear, np.float64)), 0, 1))


def decibels(ours: ArrayLike, theirs: ArrayLike) -> float:
    """PSNR of values in 0…1; NaN if any of them is."""
    return decibels_of(float(np.mean((np.asarray(ours, np.float64) - np.asarray(theirs, np.float64)) ** 2)))


def decibels_of(square: float) -> float:
    """PSNR of a mean square error."""
    return square if math.isnan(square) else min(IDENTICAL_DB, -10 * math.log10(max(square, 1e-30)))
