"""Compiled look-up of a lat-long map."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def sample_latlong(radiance, directions, sampled):  # type: ignore[no-untyped-def]
    """Fill ``sampled`` [N, 3] with ``radiance`` [H, W, 3] seen towards ``directions`` [N, 3] in the map's frame.

    Bilinear between texel centres; wraps around horizontally, clamps at the poles.
    """
    height, width = radiance.shape[:2]
    for k in numba.prange(len(directions)):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        column = (0.5 + math.atan2(z, x) / (2 * math.pi)) * width - 0.5
        row = math.atan2(math.sqrt(x * x + z * z), y) / math.pi * height - 0.5
        row = min(max(row, 0.0), height - 1.0)
        left, top = math.floor(column), math.floor(row)
        s, t = column - left, row - top
        right, bottom = (left + 1) % width, min(top + 1, height - 1)
        left %= width
        for c in range(3):
            upper = (1 - s) * radiance[top, left, c] + s * radiance[top, right, c]
            lower = (1 - s) * radiance[bottom, left, c] + s * radiance[bottom, right, c]
            sampled[k, c] = np.float32((1 - t) * upper + t * lower)
