"""Shadow maps of the plane, looked up at the pixels that see them."""

from __future__ import annotations

import numba
import numpy as np

from rnd_runtime.core.simd.arithmetic import lanes
from rnd_runtime.core.simd.memory import load, store
from rnd_runtime.core.simd.vectors import WIDTH

GROUP = 5
"""pixels of three channels in sixteen lanes"""
_PARTS = 32  # units of parallel work, of rows far apart: most of the ground is at the bottom
_ONE = np.float32(1)
_PIXELS = (np.arange(WIDTH) // 3).astype(np.float32)
_CHANNELS = np.concatenate([np.arange(WIDTH) % 3 == c for c in range(3)]).astype(np.float32)


@numba.njit(inline="always", error_model="numpy")
def _columns(to_map, row, rows, columns, width):  # type: ignore[no-untyped-def]
    """Columns of an image's row from which the plane lies within a map of ``rows`` × ``columns`` nodes.

    ``to_map`` [3, 3] takes (column, row, 1) to the map's row, column and a positive depth, homogeneous: within a row
    of the image, each side of the map is a linear inequality.
    """
    low, high = 0.0, float(width)
    for side in range(5):
        if side == 0:
            slope, rest = to_map[2, 0], to_map[2, 1] * row + to_map[2, 2] - 1e-9
        else:
            axis = (side - 1) >> 1
            slope, rest = to_map[axis, 0], to_map[axis, 1] * row + to_map[axis, 2]
            if side & 1 == 0:
                last = (rows, columns)[axis] - 1
                slope = last * to_map[2, 0] - slope
                rest = last * (to_map[2, 1] * row + to_map[2, 2]) - rest
        if slope > 0:
            low = max(low, -rest / slope - 0.5)
        elif slope < 0:
            high = min(high, -rest / slope + 0.5)
        elif rest < 0:
            high = low
    if not low < high:
        return 0, 0
    return int(np.ceil(low)), int(max(np.floor(high), np.ceil(low)))


@numba.njit(inline="always", error_model="numpy")
def _cell(to_map, column, row, rows, columns):  # type: ignore[no-untyped-def]
    """Cell of a pixel in a map, and the position within it."""
    depth = 1 / (to_map[2, 0] * column + to_map[2, 1] * row + to_map[2, 2])
    i = (to_map[0, 0] * column + to_map[0, 1] * row + to_map[0, 2]) * depth
    j = (to_map[1, 0] * column + to_map[1, 1] * row + to_map[1, 2]) * depth
    i0, j0 = min(max(int(i), 0), rows - 2), min(max(int(j), 0), columns - 2)
    return i0, j0, np.float32(i - i0), np.float32(j - j0)


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def sky_light(to_map, values, step, image):  # type: ignore[no-untyped-def]
    """Fill an image [H, W, 3] with one minus a map's ``values`` [I, J, 4].

    Every ``step``-th pixel of a row is looked up, a multiple of ``GROUP`` or 1; those between are interpolated.
    """
    height, width = image.shape[:2]
    result = image.reshape(-1)
    for part in numba.prange(_PARTS):
        near, far = np.empty(4, np.float32), np.empty(4, np.float32)
        for y in range(part, height, _PARTS):
            row, start = y + 0.5, 3 * y * width
            low, high = _columns(to_map, row, values.shape[0], values.shape[1], width)
            result[start : start + 3 * low] = _ONE
            result[start + 3 * high : start + 3 * width] = _ONE
            if low < high:
                _read(to_map, low, row, values, near)
            x = low
            while step > 1 and x + step < high:
                _read(to_map, x + step, row, values, far)
                _store_ramp(result, start + 3 * x, near, far, step)
                x += step
                for c in range(3):
                    near[c] = far[c]
            for k in range(x, high):
                _read(to_map, k, row, values, near)
                for c in range(3):
                    result[start + 3 * k + c] = near[c]


@numba.njit(error_model="numpy")
def _store_ramp(result, at, near, far, step):  # type: ignore[no-untyped-def]
    """``step`` pixels of a row from ``near`` [3] towards ``far``, and one number beyond, which comes later."""
    share = _ONE / np.float32(step)
    value, rise = lanes(np.float32(0)), lanes(np.float32(0))
    for c in range(3):
        of_channel = load(_CHANNELS, c * WIDTH)
        value += near[c] * of_channel
        rise += ((far[c] - near[c]) * share) * of_channel
    value += rise * load(_PIXELS, 0)
    for k in range(0, step, GROUP):
        store(result, at + 3 * k, value)
        value += rise * np.float32(GROUP)


@numba.njit(inline="always", error_model="numpy")
def _read(to_map, x, row, values, out):  # type: ignore[no-untyped-def]
    i, j, a, b = _cell(to_map, x + 0.5, row, values.shape[0], values.shape[1])
    one = _ONE
    w00, w01, w10, w11 = (one - a) * (one - b), (one - a) * b, a * (one - b), a * b
    for c in range(4):
        blocked = w00 * values[i, j, c] + w01 * values[i, j + 1, c]
        out[c] = one - (blocked + w10 * values[i + 1, j, c] + w11 * values[i + 1, j + 1, c])


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def subtract_sun(to_map, values, share, remaining):  # type: ignore[no-untyped-def]
    """Subtract ``share`` [3] of a map's ``values`` [I, J] from every pixel of ``remaining`` [H, W, 3], not below 0."""
    height, width = remaining.shape[:2]
    zero = np.float32(0)
    red, green, blue = share[0], share[1], share[2]
    for part in numba.prange(_PARTS):
        for y in range(part, height, _PARTS):
            row = y + 0.5
            low, high = _columns(to_map, row, values.shape[0], values.shape[1], width)
            for x in range(low, high):
                blocked = _blocked(to_map, x, row, values)
                if blocked > zero:
                    remaining[y, x, 0] = max(remaining[y, x, 0] - red * blocked, zero)
                    remaining[y, x, 1] = max(remaining[y, x, 1] - green * blocked, zero)
                    remaining[y, x, 2] = max(remaining[y, x, 2] - blue * blocked, zero)


@numba.njit(inline="always", error_model="numpy")
def _blocked(to_map, x, row, values):  # type: ignore[no-untyped-def]
    i, j, a, b = _cell(to_map, x + 0.5, row, values.shape[0], values.shape[1])
    near = values[i, j] * (_ONE - b) + values[i, j + 1] * b
    far = values[i + 1, j] * (_ONE - b) + values[i + 1, j + 1] * b
    return near + (far - near) * a


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def block_sun(to_map, values, blocked):  # type: ignore[no-untyped-def]
    """Raise an image [H, W] of a sun's blocked share to a map's ``values`` [I, J]."""
    height, width = blocked.shape
    for part in numba.prange(_PARTS):
        for y in range(part, height, _PARTS):
            row = y + 0.5
            low, high = _columns(to_map, row, values.shape[0], values.shape[1], width)
            for x in range(low, high):
                blocked[y, x] = max(blocked[y, x], _blocked(to_map, x, row, values))


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def add_lights(left, of_sky, blocked, shares):  # type: ignore[no-untyped-def]
    """Make the share of the sky that is ``left`` [H, W, 3] that of all light, not below 0.

    ``of_sky`` [3] of it is the sky's, ``shares`` [S, 3] are the suns', of which ``blocked`` [S, H, W] is blocked.
    """
    for y in numba.prange(left.shape[0]):
        for x in range(left.shape[1]):
            for c in range(3):
                share = _ONE - of_sky[c] * (_ONE - left[y, x, c])
                for sun in range(len(shares)):
                    share -= shares[sun, c] * blocked[sun, y, x]
                left[y, x, c] = max(share, np.float32(0))
