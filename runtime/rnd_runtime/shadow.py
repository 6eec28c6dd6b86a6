"""Which points of a body a distant light reaches: depth maps splatted from the points themselves.

No mesh and no capsules: any cloud of points with normals on closed surfaces will do, so clothing and other
skeletons need nothing of their own. Per direction, every point that faces the light is drawn as a small disc
in its tangent plane into an orthographic map that keeps what lies nearest to the light; then every point
looks up the four texels around it (percentage-closer filtering, Reeves et al. 1987) and compares along its
own tangent plane, so that a slope casts no shadow on itself.

Against exact tracing 99.1 % of the points of a person made of capsules agree (256² texels). 30 000 points take
0.9 ms a direction on two cores, 1.8 ms when there is one direction only.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

Floats32 = NDArray[np.float32]

# How far a blocker must rise above a point's tangent plane, in disc radii: a disc of radius r beside it on a
# surface of curvature 1/R rises r²/2R. 0.5 is enough for exact normals; those of a trained avatar disagree by some
# 10° and speckled its limbs (28.9 dB instead of 29.0 on relit pictures). More loses shadows where limbs touch.
_CLEARANCE = np.float32(1.0)
# ... and no less than this many texels, which is what rounding to the map's grid costs on curved surfaces.
_CLEARANCE_TEXELS = np.float32(0.35)
_COSINE_FLOOR = np.float32(0.1)  # steeper tangent planes are treated as 84°: their depth tells nothing
_EMPTY = np.float32(-np.inf)


def directional_visibility(
    points: ArrayLike,
    normals: ArrayLike,
    directions: ArrayLike,
    *,
    radii: ArrayLike,
    resolution: int = 256,
) -> Floats32:
    """How much of a distant light in each direction reaches each point past all other points, in [0, 1].

    Args:
        points: [N, 3] m, on closed surfaces.
        normals: [N, 3] unit, outward, in the frame of the points.
        directions: [K, 3] unit, **towards** the lights, in the same frame.
        radii: [N] m or one for all: the distance between neighbours on a lattice, 1.25 times the mean spacing
            where points are scattered at random (1.0 leaves 4 % of the surface open). A point of radius 0
            casts no shadow and still receives them.
        resolution: texels along the longer side of a depth map, which is cut to the points' bounds.

    Returns:
        [N, K]; 0 where the point faces away from the light. Points that are not finite get 0, cast nothing.
    """
    # copies: the kernel would be compiled anew for arrays that are read-only
    points, normals, directions = (np.array(a, np.float32, order="C") for a in (points, normals, directions))
    if not (points.ndim == 2 and points.shape[1] == 3 and normals.shape == points.shape):
        raise InputError(
            "points and normals of a shadow", expected="[N, 3] both", got=f"{points.shape}, {normals.shape}"
        )
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise InputError("directions of a shadow", expected="[K, 3]", got=directions.shape)
    if not 8 <= resolution <= 8192:
        raise InputError("resolution of a depth map", expected="8 to 8192 texels", got=resolution)
    disc_radii = np.full(len(points), radii, np.float32)
    visibility = np.zeros((len(directions), len(points)), np.float32)
    _all_directions(points, normals, directions, disc_radii, resolution, visibility)
    return visibility.T


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _all_directions(points, normals, directions, radii, resolution, visibility):  # type: ignore[no-untyped-def]
    for k in numba.prange(len(directions)):
        _one_direction(points, normals, directions[k], radii, resolution, visibility[k])


@numba.njit(cache=True, error_model="numpy")
def _one_direction(points, normals, direction, radii, resolution, visibility):  # type: ignore[no-untyped-def]
    count = len(points)
    frame = _frame(direction)
    position = np.empty((count, 3), np.float32)  # x, y in the map's plane, z towards the light
    normal = np.empty((count, 3), np.float32)
    lower = np.full(2, np.float32(np.inf), np.float32)
    upper = np.full(2, np.float32(-np.inf), np.float32)
    for i in range(count):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        if not np.isfinite(px + py + pz + nx + ny + nz + radii[i]):
            normal[i, 2] = -1  # faces away: neither casts nor receives
            continue
        for axis in range(3):
            fx, fy, fz = frame[axis, 0], frame[axis, 1], frame[axis, 2]
            position[i, axis] = fx * px + fy * py + fz * pz
            normal[i, axis] = fx * nx + fy * ny + fz * nz
        for axis in range(2):
            lower[axis] = min(lower[axis], position[i, axis])
            upper[axis] = max(upper[axis], position[i, axis])
    extent = max(upper[0] - lower[0], upper[1] - lower[1])
    if not extent > 0:  # a single point, or none: nothing to cast
        extent = np.float32(1)
    # texel centres lie at integers; one empty row all around serves the lookup of the outermost points
    texel = extent / np.float32(resolution - 3)
    width = int((upper[0] - lower[0]) / texel) + 3 if upper[0] >= lower[0] else 3
    height = int((upper[1] - lower[1]) / texel) + 3 if upper[1] >= lower[1] else 3
    depth = np.full((height, width), _EMPTY, np.float32)
    for i in range(count):
        if normal[i, 2] > 0:
            position[i, 0] = (position[i, 0] - lower[0]) / texel + 1
            position[i, 1] = (position[i, 1] - lower[1]) / texel + 1
            if radii[i] > 0:
                _draw_disc(depth, position[i], normal[i], radii[i], texel)
    for i in range(count):
        if normal[i, 2] > 0:
            visibility[i] = _look_up(depth, position[i], normal[i], radii[i], texel)


@numba.njit(cache=True)
def _frame(direction):  # type: ignore[no-untyped-def]
    """Rows: two axes across ``direction`` and the direction itself, a right-handed orthonormal frame."""
    frame = np.empty((3, 3), np.float32)
    z = direction / np.sqrt((direction * direction).sum())
    helper = np.zeros(3, np.float32)
    helper[np.argmin(np.abs(z))] = 1
    x = np.cross(helper, z)
    frame[0] = x / np.sqrt((x * x).sum())
    frame[1] = np.cross(z, frame[0])
    frame[2] = z
    return frame


@numba.njit(inline="always")
def _slopes(normal, texel):  # type: ignore[no-untyped-def]
    """Rise of the tangent plane towards the light, in metres a texel, along x and y."""
    scale = -texel / max(normal[2], _COSINE_FLOOR)
    return normal[0] * scale, normal[1] * scale


@numba.njit(cache=True, error_model="numpy")
def _draw_disc(depth, position, normal, radius, texel):  # type: ignore[no-untyped-def]
    """Keep the disc's plane where it is nearer to the light than what the map holds."""
    height, width = depth.shape
    x, y, z = position
    slope_x, slope_y = _slopes(normal, texel)
    reach = radius / texel
    for row in range(max(int(np.ceil(y - reach)), 0), min(int(np.floor(y + reach)) + 1, height)):
        for column in range(max(int(np.ceil(x - reach)), 0), min(int(np.floor(x + reach)) + 1, width)):
            dx, dy = np.float32(column) - x, np.float32(row) - y
            rise = slope_x * dx + slope_y * dy
            if (dx * dx + dy * dy) * texel * texel + rise * rise <= radius * radius:
                depth[row, column] = max(depth[row, column], z + rise)


@numba.njit(cache=True, error_model="numpy")
def _look_up(depth, position, normal, radius, texel):  # type: ignore[no-untyped-def]
    """Bilinear share of the four texels around a point in which nothing rises above its plane."""
    x, y, z = position
    slope_x, slope_y = _slopes(normal, texel)
    clearance = max(_CLEARANCE * radius, _CLEARANCE_TEXELS * texel) / max(normal[2], _COSINE_FLOOR)
    column, row = int(x), int(y)  # positive, and one texel short of the far edge
    lit = np.float32(0)
    for corner in range(4):
        c, r = column + (corner & 1), row + (corner >> 1)
        dx, dy = np.float32(c) - x, np.float32(r) - y
        if not depth[r, c] > z + slope_x * dx + slope_y * dy + clearance:
            lit += (1 - abs(dx)) * (1 - abs(dy))
    return min(lit, np.float32(1))
