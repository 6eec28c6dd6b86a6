"""Bilinear enlargement of an image rendered below full resolution (numba)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from rnd_runtime.core.arrays import Floats32


def enlarged(image: Floats32, height: int, width: int) -> Floats32:
    """``image`` [h, w, C] at ``height`` × ``width``, bilinear between pixel centres."""
    result = np.empty((height, width, image.shape[2]), np.float32)
    _enlarge(np.ascontiguousarray(image, np.float32), result)
    return result


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _enlarge(image, result):  # type: ignore[no-untyped-def]
    height, width, channels = image.shape
    for y in prange(len(result)):
        row = min(max((y + 0.5) * height / len(result) - 0.5, 0.0), height - 1.0)
        top = int(row)
        below, t = min(top + 1, height - 1), np.float32(row - top)
        for x in range(result.shape[1]):
            column = min(max((x + 0.5) * width / result.shape[1] - 0.5, 0.0), width - 1.0)
            left = int(column)
            right, s = min(left + 1, width - 1), np.float32(column - left)
            for c in range(channels):
                upper = image[top, left, c] + s * (image[top, right, c] - image[top, left, c])
                lower = image[below, left, c] + s * (image[below, right, c] - image[below, left, c])
                result[y, x, c] = upper + t * (lower - upper)
