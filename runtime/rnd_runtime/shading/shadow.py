"""Visibility of directional lights: depth maps splatted from the points of a body.

For each direction, every point that faces the light is rendered as a disc in its tangent plane into an orthographic map
of the nearest depths. Each point then compares the four texels around it (percentage-closer filtering, Reeves et al.
1987) along its own tangent plane, against self-shadowing. Visibility is continuous in the positions.

99.1 % of the points of a person made of capsules agree with exact tracing (256² texels). The result does not depend on
the number of threads, to the bit.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, mask
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.simd.arithmetic import block_x, block_y, lanes, maximum
from rnd_runtime.core.simd.memory import aligned_floats, load, store
from rnd_runtime.core.simd.vectors import WIDTH

Floats32 = NDArray[np.float32]

# Min rise of a blocker above a point's tangent plane, in disc radii. 0.5 suffices for exact normals; a trained avatar's
# disagree by 10°, which speckles its limbs (28.9 dB instead of 29.0 on relit images). More loses contact shadows.
DEPTH_BIAS = np.float32(1.0)
CLEARANCE_TEXELS = np.float32(0.35)  # min clearance in texels, for the map's rounding on curved surfaces
# All transitions are continuous. A plane falls by DROP metres (more than a body's depth) over RIM_TEXELS beyond its
# disc, and sinks by as much as the cosine of its normal goes from EDGE_ON to 0. Light fades between rises of
# 1 − SOFTNESS and 1 + SOFTNESS clearances.
DROP, RIM_TEXELS = np.float32(2), np.float32(0.5)
EDGE_ON = np.float32(0.02)
SOFTNESS = np.float32(0.25)
SLOPE_FLOOR = np.float32(0.1)  # min cosine of a tangent plane: 84°
_FAR = np.float32(np.inf)
_EMPTY = -_FAR
_NOWHERE = (_FAR, _FAR, -_FAR, -_FAR)  # empty bounds
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
BLOCK_SHIFT = 2
BLOCK = 1 << BLOCK_SHIFT  # texels; a block is one value of sixteen lanes
_CHUNK = 1024  # points per unit of parallel work


def directional_visibility(
    points: ArrayLike,
    normals: ArrayLike,
    directions: ArrayLike,
    *,
    radii: ArrayLike,
    resolution: int = 256,
    receivers: ArrayLike | None = None,
) -> Floats32:
    """Share [N, K] in [0, 1] of a distant light in each direction that reaches each point.

    0 where the point faces away from the light, is no receiver or is not finite; non-finite points cast no shadow.

    Args:
        points: [N, 3] m, on closed surfaces.
        normals: [N, 3] unit, outward, in the frame of the points.
        directions: [K, 3] unit, **towards** the lights, in the same frame.
        radii: [N] m or one for all: the distance between neighbours on a lattice, 1.25 times the mean spacing of
            random points (1.0 leaves 4 % of the surface open). A point of radius 0 casts no shadow and receives them.
        resolution: texels along the longer side of a depth map, which is cropped to the points' bounds.
        receivers: [N] points whose visibility is wanted; all by default. All points cast shadows.
    """
    points, normals, directions = floats(points), floats(normals), floats(directions)
    if not (points.ndim == 2 and points.shape[1] == 3 and normals.shape == points.shape):
        raise InputError(
            "points and normals of a shadow", expected="[N, 3] both", got=f"{points.shape}, {normals.shape}"
        )
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise InputError("directions of a shadow", expected="[K, 3]", got=directions.shape)
    if not 8 <= resolution <= 8192:
        raise InputError("resolution of a depth map", expected="8 to 8192 texels", got=resolution)
    arrays = points, normals, np.full(len(points), radii, np.float32), mask(receivers, len(points))
    visibility: Floats32 = cast_shadows(arrays, directions, resolution, numba.get_num_threads())
    return visibility


@numba.njit(nogil=True, cache=True, error_model="numpy")
def cast_shadows(arrays, directions, resolution, threads):  # type: ignore[no-untyped-def]
    """``directional_visibility`` [N, K] of points, normals, radii and receivers."""
    visibility = np.zeros((len(directions), len(arrays[0])), np.float32)
    for k in range(len(directions)):
        _one_direction(arrays, axes_towards(directions[k]), resolution, threads, visibility[k])
    return np.ascontiguousarray(visibility.T)


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _one_direction(arrays, frame, resolution, threads, visibility):  # type: ignore[no-untyped-def]
    points, _, radii, receivers = arrays
    count = len(points)
    chunks = (count + _CHUNK - 1) // _CHUNK
    position = np.empty((count, 3), np.float32)  # x, y in the map's plane, z towards the light
    normal = np.empty((count, 3), np.float32)
    bounds = np.empty((chunks, 4), np.float32)
    for chunk in numba.prange(chunks):
        first, last = chunk * _CHUNK, min((chunk + 1) * _CHUNK, count)
        _to_map(arrays, frame, first, last, position, normal, bounds[chunk])
    left, bottom, right, top = _NOWHERE
    for chunk in range(chunks):
        left, bottom = min(left, bounds[chunk, 0]), min(bottom, bounds[chunk, 1])
        right, top = max(right, bounds[chunk, 2]), max(top, bounds[chunk, 3])
    extent = max(right - left, top - bottom)
    if not extent > 0:  # a single point, or none
        extent = np.float32(1)
    # texel centres are at integers; padding serves look-ups of the outermost points, with a row for rounding
    texel = extent / np.float32(resolution - 3)
    width = int((right - left) / texel) + 4 if right >= left else 4
    height = int((top - bottom) / texel) + 4 if right >= left else 4
    across, down = (width + BLOCK - 1) // BLOCK, (height + BLOCK - 1) // BLOCK
    depth = aligned_floats(across * down * WIDTH)  # block by block
    depth[:] = _EMPTY
    for i in numba.prange(count):
        if normal[i, 2] > 0:
            position[i, 0] = (position[i, 0] - left) / texel + 1
            position[i, 1] = (position[i, 1] - bottom) / texel + 1
    # threads render separate rows with about equally many discs
    edges = _bands(position, normal, down, threads)
    for band in numba.prange(len(edges) - 1):
        for i in range(count):
            if normal[i, 2] > 0 and radii[i] > 0:
                _draw_disc(depth, across, position, normal, i, radii[i], texel, edges[band], edges[band + 1])
    for i in numba.prange(count):
        if normal[i, 2] > 0 and receivers[i]:
            visibility[i] = _pcf_visibility(depth, across, position, normal, i, radii[i], texel)


@numba.njit(error_model="numpy")
def _to_map(arrays, frame, first, last, position, normal, bounds):  # type: ignore[no-untyped-def]
    """Rotate rows first … last − 1 to the axes of ``frame``; ``bounds`` are their min x, y and max x, y."""
    points, normals, radii, _ = arrays
    left, bottom, right, top = _NOWHERE
    for i in range(first, last):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        if not np.isfinite(px + py + pz + nx + ny + nz + radii[i]):
            normal[i, 2] = -1  # neither casts nor receives
            continue
        for axis in range(3):
            fx, fy, fz = frame[axis, 0], frame[axis, 1], frame[axis, 2]
            position[i, axis] = fx * px + fy * py + fz * pz
            normal[i, axis] = fx * nx + fy * ny + fz * nz
        left, right = min(left, position[i, 0]), max(right, position[i, 0])
        bottom, top = min(bottom, position[i, 1]), max(top, position[i, 1])
    bounds[0], bounds[1], bounds[2], bounds[3] = left, bottom, right, top


@numba.njit(error_model="numpy")
def _bands(position, normal, height, bands):  # type: ignore[no-untyped-def]
    """Rows of blocks [bands + 1] that split a map into bands with about equally many points that face the light."""
    points = np.zeros(height + 1, np.int64)
    for i in range(len(position)):
        if normal[i, 2] > 0:
            points[(int(position[i, 1]) >> BLOCK_SHIFT) + 1] += 1
    for row in range(height):
        points[row + 1] += points[row]
    edges = np.empty(bands + 1, np.int64)
    for band in range(bands):
        edges[band] = np.searchsorted(points[: height + 1], points[height] * band // bands)
    edges[0], edges[bands] = 0, height
    return edges


@numba.njit(cache=True)
def axes_towards(direction):  # type: ignore[no-untyped-def]
    """Right-handed orthonormal frame [3, 3] by rows: two axes across ``direction``, and the direction."""
    frame = np.zeros((3, 3), np.float32)
    x, y, z = frame[0], frame[1], frame[2]
    _normalized(direction, z)
    smallest = 0
    for axis in range(1, 3):
        smallest = axis if abs(z[axis]) < abs(z[smallest]) else smallest
    y[smallest] = 1
    _cross(y, z, x)
    _normalized(x, x)
    _cross(z, x, y)
    return frame


@numba.njit(inline="always")
def _normalized(vector, out):  # type: ignore[no-untyped-def]
    length = np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    for axis in range(3):
        out[axis] = vector[axis] / length


@numba.njit(inline="always")
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        out[axis] = a[after] * b[last] - a[last] * b[after]


@numba.njit(error_model="numpy")
def _slopes(normal, i, texel):  # type: ignore[no-untyped-def]
    """Rise of point i's tangent plane towards the light, m per texel, along x and y."""
    scale = -texel / max(normal[i, 2], SLOPE_FLOOR)
    return normal[i, 0] * scale, normal[i, 1] * scale


@numba.njit(error_model="numpy")
def _draw_disc(depth, across, position, normal, i, radius, texel, low, high):  # type: ignore[no-untyped-def]
    """Max-blend the disc's plane and its fall-off into rows of blocks ``low`` … ``high`` − 1."""
    x, y = position[i, 0], position[i, 1]
    z = position[i, 2] - DROP * max(_ONE - normal[i, 2] / EDGE_ON, _ZERO)
    slope_x, slope_y = _slopes(normal, i, texel)
    reach = radius / texel + RIM_TEXELS
    square, cosine = radius * radius, max(normal[i, 2], SLOPE_FLOOR)
    fall = DROP / (reach * reach * texel * texel - square)
    left, right = max(int(x - reach), 0) >> BLOCK_SHIFT, min((int(x + reach) >> BLOCK_SHIFT) + 1, across)
    top, bottom = max(int(y - reach), 0) >> BLOCK_SHIFT, (int(y + reach) >> BLOCK_SHIFT) + 1
    for row in range(max(top, low), min(bottom, high)):
        dy = block_y() + (np.float32(row * BLOCK) - y)
        for column in range(left, right):
            dx = block_x() + (np.float32(column * BLOCK) - x)
            rise = slope_x * dx + slope_y * dy
            # beyond the circle, and beyond its projected ellipse
            beyond = (dx * dx + dy * dy) * (texel * texel) - square
            outside = maximum(beyond, lanes(_ZERO)) + cosine * maximum(beyond + rise * rise, lanes(_ZERO))
            plane = z + rise - fall * outside
            at = (row * across + column) * WIDTH
            store(depth, at, maximum(plane, load(depth, at)))


@numba.njit(inline="always")
def _texel_index(row, column, across):  # type: ignore[no-untyped-def]
    """Index of a texel in a map of rows of ``across`` blocks of 4×4."""
    block = (row >> BLOCK_SHIFT) * across + (column >> BLOCK_SHIFT)
    return block * WIDTH + (row & BLOCK - 1) * BLOCK + (column & BLOCK - 1)


@numba.njit(error_model="numpy")
def _pcf_visibility(depth, across, position, normal, i, radius, texel):  # type: ignore[no-untyped-def]
    """Bilinear share of the four texels around a point that are lit: no blocker above its plane."""
    x, y, z = position[i, 0], position[i, 1], position[i, 2]
    slope_x, slope_y = _slopes(normal, i, texel)
    clearance = max(DEPTH_BIAS * radius, CLEARANCE_TEXELS * texel) / max(normal[i, 2], SLOPE_FLOOR)
    top, span = (_ONE + SOFTNESS) * clearance, _ONE / (_TWO * SOFTNESS * clearance)
    column, row = int(x), int(y)  # positive, one texel from the far edge
    lit = np.float32(0)
    for corner in range(4):
        c, r = column + (corner & 1), row + (corner >> 1)
        dx, dy = np.float32(c) - x, np.float32(r) - y
        open_share = (z + slope_x * dx + slope_y * dy + top - depth[_texel_index(r, c, across)]) * span
        lit += (1 - abs(dx)) * (1 - abs(dy)) * min(max(open_share, _ZERO), _ONE)
    return min(lit, np.float32(1))
