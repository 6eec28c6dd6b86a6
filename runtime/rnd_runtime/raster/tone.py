"""Linear radiance to 8-bit sRGB in one compiled pass, byte for byte ``to_bytes(linear_to_srgb(x))``.

The code is a step function: a table over the top bits of the float holds the code at its cell's start, and one
comparison decides whether x is past the cell's only step. 0.4 ms instead of 8 ms for 512² pixels, 1/6 of them covered.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import (
    MAX_RADIANCE,
    NEUTRAL_DESATURATION,
    NEUTRAL_OFFSET,
    NEUTRAL_START,
    Tone,
    linear_to_srgb,
    to_bytes,
)

Bytes = NDArray[np.uint8]
Floats32 = NDArray[np.float32]

_CELL_BITS = 7  # of the mantissa: 128 cells an octave, where sRGB makes at most 67 steps
_SHIFT = 23 - _CELL_BITS
_LOWEST = np.float32(2.0**-14)  # the code is 0 below; the first step is at 1.5e-4
_ZERO, _ONE = np.float32(0), np.float32(1)
_MAX, _OFFSET, _START_PEAK, _ROOM, _DESATURATION = map(
    np.float32, (MAX_RADIANCE, NEUTRAL_OFFSET, NEUTRAL_START, 1 - NEUTRAL_START, NEUTRAL_DESATURATION)
)
_FOUR_OFFSETS = np.float32(4 * NEUTRAL_OFFSET)


def tone_map(
    radiance: ArrayLike,
    alpha: ArrayLike,
    background: ArrayLike | None = None,
    share: ArrayLike | None = None,
    *,
    tone: Tone = "srgb",
) -> Bytes:
    """8-bit sRGB [H, W, 3] of premultiplied ``radiance`` [H, W, 3] and ``alpha`` [H, W].

    Args:
        background: linear radiance [3] or [H, W, 3]; black by default.
        share: [H, W, 3] of the background that is seen; all by default.
        tone: "neutral" applies ``core.images.neutral`` first: to the image over a map, to the body alone over one
            colour, which comes out as it is.
    """
    radiance, alpha = _checked(radiance, alpha)
    backdrop = floats(np.zeros(3) if background is None else background)
    if backdrop.shape not in ((3,), radiance.shape):
        raise InputError("background", expected=f"[3] or {radiance.shape}", got=backdrop.shape)
    image = np.empty(radiance.shape, np.uint8)
    seen = floats(np.ones((1, 3)) if share is None else share)
    if share is not None and seen.shape != radiance.shape:
        raise InputError("share of the background", expected=radiance.shape, got=seen.shape)
    curved = tone == "neutral"
    _tone_map(radiance, alpha, backdrop.reshape(-1, 3), seen.reshape(-1, 3), curved, *tone_tables(), image)
    return image


def tone_map_straight(radiance: ArrayLike, alpha: ArrayLike, *, tone: Tone = "srgb") -> Bytes:
    """8-bit sRGB and alpha [H, W, 4], not premultiplied (as in PNG); ``tone`` as of ``tone_map``."""
    radiance, alpha = _checked(radiance, alpha)
    image = np.empty((*alpha.shape, 4), np.uint8)
    _tone_map_straight(radiance, alpha, tone == "neutral", *tone_tables(), image)
    return image


def code_steps() -> Floats32:
    """The least float32 of every code, then infinity [257]: ``steps[c] <= x < steps[c + 1]`` has the code c."""
    return tone_tables()[0]


def _checked(radiance: ArrayLike, alpha: ArrayLike) -> tuple[Floats32, Floats32]:
    radiance, alpha = floats(radiance), floats(alpha)
    if alpha.ndim != 2 or radiance.shape != (*alpha.shape, 3):
        raise InputError("image", expected="[H, W, 3] and [H, W]", got=f"{radiance.shape}, {alpha.shape}")
    return radiance, alpha


@cache
def tone_tables() -> tuple[Floats32, NDArray[np.uint8]]:
    """``code_steps``, and the code at each cell's start."""
    levels = np.arange(1, 256)
    low = np.zeros(255, np.int64)  # bits of positive floats are ordered as the floats are
    high = np.full(255, np.float32(1).view(np.int32), np.int64)
    while (high - low > 1).any():
        middle = (low + high) // 2
        reached = to_bytes(linear_to_srgb(middle.astype(np.int32).view(np.float32))) >= levels
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    steps = np.concatenate([[0], high.astype(np.int32).view(np.float32), [np.inf]]).astype(np.float32)
    start = int(_LOWEST.view(np.int32)) >> _SHIFT
    cells = np.arange(start, (int(_ONE.view(np.int32)) >> _SHIFT) + 1, dtype=np.int64) << _SHIFT
    starts = cells.astype(np.int32).view(np.float32)
    first = np.searchsorted(steps, starts, side="right") - 1
    assert (np.diff(first) <= 1).all()
    return steps, first.astype(np.uint8)


@njit(inline="always")
def _code(x, steps, first):  # type: ignore[no-untyped-def]
    """The code of x: 0 for NaN and negative values, 255 above one."""
    if not x >= _LOWEST:
        return np.uint8(0)
    x = np.float32(min(x, _ONE))
    bits = x.view(np.int32)
    code = np.int64(first[(bits >> _SHIFT) - _START])
    return np.uint8(code + (1 if x >= steps[code + 1] else 0))


_START = int(_LOWEST.view(np.int32)) >> _SHIFT


@njit(inline="always")
def _neutral(red, green, blue):  # type: ignore[no-untyped-def]
    """``core.images.neutral`` of one pixel."""
    red, green, blue = _radiance(red), _radiance(green), _radiance(blue)
    low = min(red, min(green, blue))
    offset = low - low * low / _FOUR_OFFSETS if low < _OFFSET + _OFFSET else _OFFSET
    red, green, blue = red - offset, green - offset, blue - offset
    peak = max(red, max(green, blue))
    if peak <= _START_PEAK:
        return red, green, blue
    compressed = _ONE - _ROOM * _ROOM / (peak - _START_PEAK + _ROOM)
    saturation = _ONE / (_DESATURATION * (peak - compressed) + _ONE)
    return (
        compressed + saturation * (red / peak * compressed - compressed),
        compressed + saturation * (green / peak * compressed - compressed),
        compressed + saturation * (blue / peak * compressed - compressed),
    )


@njit(inline="always")
def _radiance(x):  # type: ignore[no-untyped-def]
    return min(x, _MAX) if x > _ZERO else _ZERO


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _tone_map(radiance, alpha, background, share, curved, steps, first, image):  # type: ignore[no-untyped-def]
    height, width = alpha.shape
    one_colour, whole = len(background) == 1, len(share) == 1
    empty = np.empty(3 * width, np.uint8)  # a row of the background colour
    for c in range(3):
        empty[c::3] = _code(background[0, c], steps, first)
    rows = image.reshape(height, 3 * width)
    for y in prange(height):
        if one_colour:
            for k in range(3 * width):
                rows[y, k] = empty[k]
        for x in range(width):
            left = _ONE - alpha[y, x]
            at, seen = 0 if one_colour else y * width + x, 0 if whole else y * width + x
            if one_colour and left == _ONE and min(share[seen, 0], share[seen, 1], share[seen, 2]) == _ONE:
                continue
            if curved and one_colour:
                a = alpha[y, x] if alpha[y, x] > _ZERO else _ONE
                toned = _neutral(radiance[y, x, 0] / a, radiance[y, x, 1] / a, radiance[y, x, 2] / a)
                for c in range(3):
                    behind = background[at, c] * share[seen, c]
                    image[y, x, c] = _code(a * toned[c] + left * behind, steps, first)
                continue
            if curved:
                toned = _neutral(
                    radiance[y, x, 0] + left * background[at, 0] * share[seen, 0],
                    radiance[y, x, 1] + left * background[at, 1] * share[seen, 1],
                    radiance[y, x, 2] + left * background[at, 2] * share[seen, 2],
                )
                for c in range(3):
                    image[y, x, c] = _code(toned[c], steps, first)
                continue
            for c in range(3):
                behind = background[at, c] * share[seen, c]
                image[y, x, c] = _code(radiance[y, x, c] + left * behind, steps, first)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _tone_map_straight(radiance, alpha, curved, steps, first, image):  # type: ignore[no-untyped-def]
    height, width = alpha.shape
    for y in prange(height):
        for x in range(width):
            a = alpha[y, x]
            if not a > _ZERO:
                a = _ONE
            colour = radiance[y, x, 0] / a, radiance[y, x, 1] / a, radiance[y, x, 2] / a
            if curved:
                colour = _neutral(colour[0], colour[1], colour[2])
            for c in range(3):
                image[y, x, c] = _code(colour[c], steps, first)
            image[y, x, 3] = np.uint8(np.floor(min(max(alpha[y, x], _ZERO), _ONE) * np.float32(255) + np.float32(0.5)))
