"""The sky's shadow: the body in horizontal slices, each moved along every direction of the sky, and their union summed.

Moving a slice is a shift by whole cells, so a direction costs as much as a few maxima over the body's cells. Directions
are many enough that none needs a blur of its own.
"""

from __future__ import annotations

import numba
import numpy as np

from rnd_runtime.core.simd.arithmetic import lanes, maximum
from rnd_runtime.core.simd.memory import load, store
from rnd_runtime.core.simd.vectors import WIDTH

CELL, REACH = np.float32(0.05), 2.4
"""m, cell and half side of the map around the body"""
CELLS = round(2 * REACH / float(CELL))
_SLICE = np.float32(0.05)  # m
_MAX_SLICES = 64
_MAX_DISCS = 4096  # a cell holds several
_GAP = np.float32(1.5)  # cells between copies of a slice: discs are larger
_PARTS = 4  # of the directions, summed apart: the result does not depend on the number of threads
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def sky_map(discs, centre, directions, shares):  # type: ignore[no-untyped-def]
    """Blocked share [CELLS, CELLS, 4] of the ground's light, RGB and 0.

    Args:
        discs: [n, 4] as of ``StandIn``.
        centre: [2] m, of the map.
        directions: [K, 3] unit, towards the sky, in the discs' axes.
        shares: [K, 3] of the ground's light that comes from each.
    """
    i0, j0 = centre[0] - np.float32(REACH), centre[1] - np.float32(REACH)
    slices, first, last, corner, rows, width = _sliced(discs, i0, j0)
    span = CELLS + 2 * width  # a row of scratch, with room for slices that stick out
    sums = np.zeros((_PARTS, 3 * CELLS * span + WIDTH), np.float32)
    for part in numba.prange(_PARTS):
        covered = np.zeros(CELLS * span + WIDTH, np.float32)
        mine = sums[part]
        for k in range(part, len(directions), _PARTS):
            sine = directions[k, 2]
            step_i, step_j = -directions[k, 0] / (sine * CELL), -directions[k, 1] / (sine * CELL)
            copies = int(np.sqrt(step_i * step_i + step_j * step_j) * _SLICE / _GAP) + 1
            top, bottom, left, right = CELLS, 0, span, 0
            for s in range(len(first)):
                if first[s] >= last[s]:
                    continue
                for copy in range(copies):
                    height = (np.float32(s) + (np.float32(copy) + _HALF) / np.float32(copies)) * _SLICE
                    shift_i = int(np.floor(height * step_i + _HALF)) + corner[0]
                    start = int(np.floor(height * step_j + _HALF)) + corner[1] + width
                    if start < 0 or start > CELLS + width:
                        continue
                    low, high = max(first[s] + shift_i, 0), min(last[s] + shift_i, CELLS)
                    if low >= high:
                        continue
                    for i in range(low, high):
                        at, source = i * span + start, (s * rows + i - shift_i) * width
                        for j in range(0, width, WIDTH):
                            store(covered, at + j, maximum(load(covered, at + j), load(slices, source + j)))
                    top, bottom = min(top, low), max(bottom, high)
                    left, right = min(left, start), max(right, start + width)
            red, green, blue = lanes(shares[k, 0]), lanes(shares[k, 1]), lanes(shares[k, 2])
            plane = CELLS * span
            for i in range(top, bottom):
                for at in range(i * span + left, i * span + right, WIDTH):
                    here = load(covered, at)
                    store(covered, at, lanes(_ZERO))
                    store(mine, at, load(mine, at) + red * here)
                    store(mine, at + plane, load(mine, at + plane) + green * here)
                    store(mine, at + 2 * plane, load(mine, at + 2 * plane) + blue * here)
    result = np.zeros((CELLS, CELLS, 4), np.float32)
    for i in numba.prange(CELLS):
        for channel in range(3):
            at = (channel * CELLS + i) * span + width
            for j in range(0, CELLS, WIDTH):
                total = load(sums[0], at + j)
                for part in range(1, _PARTS):
                    total += load(sums[part], at + j)
                store(sums[0], at + j, total)
            for j in range(CELLS):
                result[i, j, channel] = sums[0, at + j]
    return result


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _sliced(discs, i0, j0):  # type: ignore[no-untyped-def]
    """Coverage of the cells by discs, slice by slice.

    Returns:
        Flat slices [S, rows, width]; first and last row of each; the slices' corner in the map; rows and width.
    """
    low_i, low_j, high_i, high_j = CELLS, CELLS, 0, 0
    count, step = 0, (len(discs) + _MAX_DISCS - 1) // _MAX_DISCS
    for k in range(0, len(discs), step):
        i, j = int((discs[k, 0] - i0) / CELL), int((discs[k, 1] - j0) / CELL)
        if 2 <= i < CELLS - 2 and 2 <= j < CELLS - 2:
            low_i, low_j, high_i, high_j = min(low_i, i), min(low_j, j), max(high_i, i), max(high_j, j)
            count = max(count, min(int(discs[k, 2] / _SLICE), _MAX_SLICES - 1) + 1)
    corner = (low_i - 2, low_j - 2)
    rows = max(high_i - low_i + 5, 0)
    width = (max(high_j - low_j + 5, 1) + WIDTH - 1) // WIDTH * WIDTH
    slices = np.zeros(count * rows * width, np.float32)
    first, last = np.full(count, rows, np.int64), np.zeros(count, np.int64)
    for k in range(0, len(discs), step):
        a, b = (discs[k, 0] - i0) / CELL, (discs[k, 1] - j0) / CELL
        i, j = int(a), int(b)
        if not (2 <= i < CELLS - 2 and 2 <= j < CELLS - 2):
            continue
        s = min(int(discs[k, 2] / _SLICE), _MAX_SLICES - 1)
        reach = discs[k, 3] / CELL + _HALF
        i, j, a, b = i - corner[0], j - corner[1], a - corner[0] - _HALF, b - corner[1] - _HALF
        for row in range(i - 1, i + 2):
            for column in range(j - 1, j + 2):
                x, y = np.float32(row) - a, np.float32(column) - b
                inside = min(reach - np.sqrt(x * x + y * y), _ONE)
                at = (s * rows + row) * width + column
                slices[at] = max(slices[at], inside)
        first[s], last[s] = min(first[s], i - 1), max(last[s], i + 2)
    return slices, first, last, corner, rows, width
