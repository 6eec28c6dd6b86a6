"""Sharpening of an avatar's outlines after blending.

Overlapping discs fade over three to four pixels at an outline. The coverage α is sharpened symmetrically about ½, and
features / α stays:

    α' = α² (3 − 2 α)        features' = features · α (3 − 2 α)

Training and splat files blend without it.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numba import njit, prange

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.gaussians import Raster

_ZERO, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 1, 2, 3))


def sharpened(raster: Raster) -> Raster:
    """``raster`` with sharpened outlines; modifies its arrays, and counts the time as "raster"."""
    started = perf_counter()
    image, alpha, depth = (np.require(a, np.float32, ["C", "W"]) for a in (raster.image, raster.alpha, raster.depth))
    _sharpen(image, alpha, depth)
    seconds = dict(raster.seconds)
    seconds["raster"] = seconds.get("raster", 0.0) + perf_counter() - started
    return replace(raster, image=image, alpha=alpha, depth=depth, seconds=seconds)


@njit(inline="always")
def sharpening(covered):  # type: ignore[no-untyped-def]
    """Factor for coverage and features of a pixel with coverage ``covered``."""
    return covered * (_THREE - _TWO * covered) if _ZERO < covered < _ONE else _ONE


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _sharpen(image: Floats32, alpha: Floats32, depth: Floats32) -> None:
    height, width, channels = image.shape
    for y in prange(height):
        for x in range(width):
            covered = alpha[y, x]
            if not _ZERO < covered < _ONE:
                continue
            factor = sharpening(covered)
            alpha[y, x] = covered * factor
            depth[y, x] *= factor
            for c in range(channels):
                image[y, x, c] *= factor
