"""A directional light's shadow: the body's discs projected along it, band by band of height, each blurred.

A map's rows run along the light's azimuth, so a projected disc is an ellipse with its axes along the map's.
"""

from __future__ import annotations

import numba
import numpy as np

from rnd_runtime.core.simd.arithmetic import block_x, block_y, lanes, maximum, select
from rnd_runtime.core.simd.memory import load, store
from rnd_runtime.core.simd.vectors import WIDTH

_STRIPS = 4  # units of parallel work
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan", "ninf", "nsz"})
def bounds(discs, cosine, sine, cotangent):  # type: ignore[no-untyped-def]
    """Min and max of the projected discs' places along the azimuth and across it; largest radius and height; all m."""
    low_u, high_u, low_v, high_v = np.float32(1e9), np.float32(-1e9), np.float32(1e9), np.float32(-1e9)
    radius, height = _ZERO, _ZERO
    for k in range(len(discs)):
        u = discs[k, 0] * cosine + discs[k, 1] * sine - discs[k, 2] * cotangent
        v = discs[k, 1] * cosine - discs[k, 0] * sine
        low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
        radius, height = max(radius, discs[k, 3]), max(height, discs[k, 2])
    return low_u, high_u, low_v, high_v, radius, height


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def sun_map(discs, starts, towards, origin, cells, shape, blur):  # type: ignore[no-untyped-def]
    """Blocked share [rows, columns] of the light.

    Args:
        discs, starts: as of ``StandIn``.
        towards: azimuth's cosine and sine, and the elevation's sine and cotangent.
        origin: m, the first cell's corner along the azimuth and across it.
        cells: m, along and across.
        shape: rows, across, and columns, along.
        blur: half width of the averaging box over the distance to the ground, tan.
    """
    rows, columns = shape
    bands = len(starts) - 1
    places = np.empty((len(discs), 4), np.float32)  # cells: along, across, and half a disc's columns and rows
    box = np.empty((bands, 4), np.int64)  # row, row, column, column
    wide = np.zeros((bands, 2), np.int64)  # cells of blur, along and across
    for band in numba.prange(bands):
        _place(discs, starts[band], starts[band + 1], towards, origin, cells, blur, places, box[band], wide[band])
        box[band, 0], box[band, 1] = max(box[band, 0], 0), min(box[band, 1], rows)
        box[band, 2], box[band, 3] = max(box[band, 2], 0), min(box[band, 3], columns)
    bases, pitches = np.zeros(bands + 1, np.int64), np.zeros(bands, np.int64)
    for band in range(bands):
        high, across = box[band, 1] - box[band, 0], box[band, 3] - box[band, 2]
        pitches[band] = (max(across, 0) + 2 * WIDTH - 1) // WIDTH * WIDTH
        bases[band + 1] = bases[band] + max(high, 0) * pitches[band]
    covered = np.empty(bases[bands] + WIDTH, np.float32)
    scale = (cells[0] * towards[2], cells[1])  # m across the light of a cell
    for strip in numba.prange(_STRIPS):
        line = np.empty(columns, np.float32)
        for band in range(bands):
            top, bottom, left, right = box[band]
            low, high = top + (bottom - top) * strip // _STRIPS, top + (bottom - top) * (strip + 1) // _STRIPS
            if low >= high or left >= right:
                continue
            base = bases[band] - top * pitches[band]
            covered[base + low * pitches[band] : base + high * pitches[band]] = _ZERO
            for k in range(starts[band], starts[band + 1]):
                first = max(int(places[k, 1] - places[k, 3]), low)
                last = min(int(places[k, 1] + places[k, 3]) + 1, high)
                if first < last:
                    _draw(covered, base, pitches[band], places[k], discs[k, 3], scale, first, last, left, right)
            for row in range(low, high):
                at = base + row * pitches[band]
                _average(covered[at : at + right - left], wide[band, 0], line)
    result = np.empty((rows, columns), np.float32)
    for strip in numba.prange(_STRIPS):
        low, high = rows * strip // _STRIPS, rows * (strip + 1) // _STRIPS
        result[low:high] = _ONE
        total = np.empty(columns, np.float32)
        for band in range(bands):
            top, bottom, left, right = box[band]
            if left >= right:
                continue
            base = bases[band] - top * pitches[band]
            _multiply(result, low, high, covered, base, pitches[band], box[band], wide[band, 1], total)
        for row in range(low, high):
            for column in range(columns):
                result[row, column] = _ONE - result[row, column]
    return result


@numba.njit(error_model="numpy")
def _place(discs, first, last, towards, origin, cells, blur, places, box, wide):  # type: ignore[no-untyped-def]
    """Fill the places of a band's discs, their box of cells (empty: its rows) and the cells of their blur."""
    cosine, sine, rise, cotangent = towards
    box[0], box[1], box[2], box[3] = 1 << 30, 0, 1 << 30, 0
    heights = _ZERO
    to_columns, to_rows = _ONE / (rise * cells[0]), _ONE / cells[1]
    for k in range(first, last):
        u = discs[k, 0] * cosine + discs[k, 1] * sine - discs[k, 2] * cotangent
        v = discs[k, 1] * cosine - discs[k, 0] * sine
        places[k, 0], places[k, 1] = (u - origin[0]) / cells[0], (v - origin[1]) / cells[1]
        heights += discs[k, 2]
        reach = discs[k, 3] + _HALF * _HALF * (rise * cells[0] + cells[1])
        along, across = reach * to_columns, reach * to_rows
        places[k, 2], places[k, 3] = along, across
        box[0], box[1] = min(box[0], int(places[k, 1] - across)), max(box[1], int(places[k, 1] + across) + 1)
        box[2], box[3] = min(box[2], int(places[k, 0] - along)), max(box[3], int(places[k, 0] + along) + 1)
    spread = blur * heights / (np.float32(max(last - first, 1)) * rise)
    wide[0], wide[1] = int(spread / (rise * cells[0]) + _HALF), int(spread / cells[1] + _HALF)
    box[0], box[1], box[2], box[3] = box[0] - wide[1], box[1] + wide[1], box[2] - wide[0], box[3] + wide[0]


@numba.njit(error_model="numpy")
def _draw(covered, base, pitch, place, radius, scale, first, last, left, right):  # type: ignore[no-untyped-def]
    """Max-blend a disc's coverage, one cell soft at its edge, into rows ``first`` … ``last`` − 1."""
    along, across = scale
    edge = _HALF * (along + across)
    reach = radius + _HALF * edge
    start, stop = max(int(place[0] - place[2]), left), min(int(place[0] + place[2]) + 1, right)
    sharp = _ONE / (_TWO * radius * edge)
    root = np.sqrt(sharp) * along
    lane = block_x() + np.float32(4) * block_y()
    for row in range(first, last):
        y = (np.float32(row) + _HALF - place[1]) * across
        most = (reach * reach - y * y) * sharp
        at = base + row * pitch - left
        for column in range(start, stop, WIDTH):
            x = (lane + (np.float32(column) + _HALF - place[0])) * root
            inside = most - x * x
            inside = select(inside < _ONE, inside, lanes(_ONE))
            store(covered, at + column, maximum(inside, load(covered, at + column)))


@numba.njit(error_model="numpy")
def _average(values, width, line):  # type: ignore[no-untyped-def]
    """Replace ``values`` by their means over ± ``width``, 0 beyond their ends; ``line`` is scratch."""
    if width == 0:
        return
    count, total = len(values), _ZERO
    share = _ONE / np.float32(2 * width + 1)
    for k in range(min(width, count)):
        total += values[k]
    for k in range(count):
        ahead = values[k + width] if k + width < count else _ZERO
        total += ahead - (values[k - width - 1] if k > width else _ZERO)
        line[k] = total * share
    for k in range(count):
        values[k] = max(line[k], _ZERO)


@numba.njit(error_model="numpy")
def _multiply(free, low, high, covered, base, pitch, box, width, total):  # type: ignore[no-untyped-def]
    """Multiply rows ``low`` … ``high`` − 1 by what a band, averaged over ± ``width`` rows, leaves free."""
    top, bottom, left, right = box
    low, high = max(low, top), min(high, bottom)
    count = right - left
    share = _ONE / np.float32(2 * width + 1)
    for k in range(count):
        total[k] = _ZERO
    for row in range(max(low - width, top), min(low + width, bottom)):
        at = base + row * pitch
        for k in range(count):
            total[k] += covered[at + k]
    for row in range(low, high):
        if row + width < bottom:
            at = base + (row + width) * pitch
            for k in range(count):
                total[k] += covered[at + k]
        for k in range(count):
            free[row, left + k] *= _ONE - max(total[k] * share, _ZERO)
        if row - width >= top:
            at = base + (row - width) * pitch
            for k in range(count):
                total[k] -= covered[at + k]
