"""Outlines as sharp as a body's: what is done to an image of an avatar after its Gaussians are blended.

Overlapping discs fade over three pixels or four at an outline. The coverage α of a blended image is therefore
sharpened, symmetrically about one half:

    α' = α² (3 − 2 α)        features' = features · α (3 − 2 α)

so that means over what covers a pixel, features / α, stay. Training and files of splats blend without it.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numba import njit, prange

from rnd_runtime.core.gaussians import Floats32, Raster

_ZERO, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 1, 2, 3))


def sharpened(raster: Raster) -> Raster:
    """``raster`` with a body's outlines; its own arrays are changed, and the time is counted as blending ("raster")."""
    started = perf_counter()
    image, alpha, depth = (np.require(a, np.float32, ["C", "W"]) for a in (raster.image, raster.alpha, raster.depth))
    _sharpen(image, alpha, depth)
    seconds = dict(raster.seconds)
    seconds["raster"] = seconds.get("raster", 0.0) + perf_counter() - started
    return replace(raster, image=image, alpha=alpha, depth=depth, seconds=seconds)


@njit(inline="always")
def sharpening(covered):  # type: ignore[no-untyped-def]
    """What the coverage and the features of a pixel are multiplied with, of which ``covered`` is covered."""
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
