"""Shading from tables, sixteen Gaussians at a time (numba over sixteen lanes); the tables: :mod:`.shading_tables`.

Where a Gaussian looks into the tables is worked out in lanes, one Gaussian each. The tables' rows are sixteen numbers
wide, so a look-up is a few loads of whole rows for one Gaussian; transposed, the rows are lanes of Gaussians again.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ._lanes import (
    WIDTH,
    aligned_floats,
    lanes,
    load,
    magnitude,
    root,
    select,
    spread,
    store,
    total,
    transpose,
    whole,
)
from .brdf import ROUGHNESS_RANGE
from .sh import sh_columns
from .specular_lobe import COSINE_COUNT, ROUGHNESS_COUNT

DIFFUSE_SIZE = 33  # nodes along the square: 6°, where M_j bends over 5° at the sharpest
SPECULAR_SIZE = 49
_CHUNK = 512  # Gaussians that a thread shades at a time
_ZERO, _ONE = np.float32(0), np.float32(1)
_TINY = np.float32(1e-12)
_ONE_OVER_PI = np.float32(1 / np.pi)
ROUGHNESS_LOW = np.float32(ROUGHNESS_RANGE[0])
ROUGHNESS_SPAN = np.float32(ROUGHNESS_RANGE[1] - ROUGHNESS_RANGE[0])

# A row of the specular table: RGB and nothing, of a cell's corners (0, 0), (1, 0), (0, 1) and (1, 1) in (s, t). A
# corner's share is (s or 1 − s)(t or 1 − t): constant plus slope times s, times the same of t.
_SIGNS = np.array([-1, 1], np.float32)
_S_SLOPE = np.tile(np.repeat(_SIGNS, 4), 2)
_T_SLOPE = np.repeat(_SIGNS, 8)
_S_CONSTANT, _T_CONSTANT = np.maximum(-_S_SLOPE, 0), np.maximum(-_T_SLOPE, 0)

# Rows of sixteen in the working memory of a thread: what goes in, and where to look
(_NX, _NY, _NZ, _VX, _VY, _VZ, _ROUGHNESS, _RED, _GREEN, _BLUE) = (WIDTH * k for k in range(10))
_IRRADIANCE = 10 * WIDTH  # three
(_ROW, _COLUMN, _W00, _W01, _W10, _W11) = (WIDTH * k for k in range(13, 19))  # of a table of four corners
(_S, _T, _LEVEL, _UP) = (WIDTH * k for k in range(19, 23))
_ROOM = 23 * WIDTH

_sh_columns = njit(sh_columns)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def look_up(surfaces, camera, rotations, tables, seen, radiance):  # type: ignore[no-untyped-def]
    """Fill ``radiance`` [N, 3] of the Gaussians ``seen`` [N].

    Args:
        surfaces: means [N, 3] m, normals [N, 3], albedo [N, 3], roughness [N] and visibility [N, 16].
        camera: [3] m. rotations: light → world and root → light, [3, 3] each.
        tables: diffuse [33·33, 3·16] for visibility in the root's frame; specular [7, 49·49, 16] of cells; lobes
            [16, 49, 16].
    """
    means, normals, albedo, roughness, visibility = surfaces
    for chunk in prange((len(means) + _CHUNK - 1) // _CHUNK):
        members, room = np.empty(WIDTH, np.int64), aligned_floats(_ROOM)
        rows, columns = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        count = 0
        last = min((chunk + 1) * _CHUNK, len(means))
        for i in range(chunk * _CHUNK, last):
            if seen[i]:
                for axis in range(3):
                    room[_NX + axis * WIDTH + count] = normals[i, axis]
                    room[_VX + axis * WIDTH + count] = camera[axis] - means[i, axis]
                    room[_RED + axis * WIDTH + count] = albedo[i, axis]
                room[_ROUGHNESS + count] = roughness[i]
                members[count] = i
                count += 1
            if count == WIDTH or (count > 0 and i == last - 1):
                for k in range(count, WIDTH):
                    members[k] = members[0]
                    for at in range(0, _IRRADIANCE, WIDTH):
                        room[at + k] = room[at]
                _shade_sixteen(members, visibility, rotations, tables, room, rows, columns)
                for k in range(count):
                    for channel in range(3):
                        radiance[members[k], channel] = room[_RED + channel * WIDTH + k]
                count = 0


@njit(error_model="numpy")
def _shade_sixteen(members, visibility, rotations, tables, room, rows, columns):  # type: ignore[no-untyped-def]
    """Radiance over the albedo in ``room``; ``rows`` and ``columns`` [16, 16] are there to be transposed."""
    light_to_world, root_to_light = rotations
    diffuse, specular, lobes = tables
    nx, ny, nz = transposed(light_to_world, load(room, _NX), load(room, _NY), load(room, _NZ))
    vx, vy, vz = transposed(light_to_world, load(room, _VX), load(room, _VY), load(room, _VZ))
    scale = _ONE / _at_least(root(vx * vx + vy * vy + vz * vz), _TINY)
    vx, vy, vz = vx * scale, vy * scale, vz * scale
    n_dot_v = nx * vx + ny * vy + nz * vz

    _place_in_lobes(load(room, _ROUGHNESS), n_dot_v, room)
    width = lobes.shape[1]
    for k in range(WIDTH):
        at = (int(room[_ROW + k]) * width + int(room[_COLUMN + k])) * WIDTH
        store(rows, k * WIDTH, _four_corners(lobes, at, WIDTH, width * WIDTH, room, k))
    transpose(rows, columns)
    energy, place = load(columns, 0), load(columns, 3 * WIDTH)
    mx, my, mz = _mean_direction(columns, (nx, ny, nz), (vx, vy, vz), n_dot_v)
    shrink = load(columns, 4 * WIDTH), load(columns, 5 * WIDTH), load(columns, 6 * WIDTH)

    for k in range(WIDTH):
        store(rows, k * WIDTH, load(visibility, members[k] * WIDTH))
    transpose(rows, columns)
    energy = energy * _at_least(_open_share(root_to_light, (mx, my, mz), shrink, columns), _ZERO)

    _place_in_square(mx, my, mz, SPECULAR_SIZE, room)
    level = whole(_clamped(place, np.float32(len(specular) - 2)))
    store(room, _LEVEL, level)
    store(room, _UP, place - level)
    s_slope, s_constant = load(_S_SLOPE, 0), load(_S_CONSTANT, 0)
    t_slope, t_constant = load(_T_SLOPE, 0), load(_T_CONSTANT, 0)
    stride = SPECULAR_SIZE * SPECULAR_SIZE * WIDTH  # of a level
    for k in range(WIDTH):
        at = int(room[_LEVEL + k]) * stride
        at += (int(room[_ROW + k]) * SPECULAR_SIZE + int(room[_COLUMN + k])) * WIDTH
        lower, upper = load(specular, at), load(specular, at + stride)
        share = (s_constant + s_slope * room[_S + k]) * (t_constant + t_slope * room[_T + k])
        store(rows, k * WIDTH, share * (lower + room[_UP + k] * (upper - lower)))
    transpose(rows, columns)

    _place_in_square(nx, ny, nz, DIFFUSE_SIZE, room)
    row = 3 * WIDTH  # of one node
    for k in range(WIDTH):
        at = (int(room[_ROW + k]) * DIFFUSE_SIZE + int(room[_COLUMN + k])) * row
        coefficients = load(visibility, members[k] * WIDTH)
        for channel in range(3):
            met = _four_corners(diffuse, at + channel * WIDTH, row, DIFFUSE_SIZE * row, room, k)
            room[_IRRADIANCE + channel * WIDTH + k] = total(coefficients * met)

    for channel in range(3):
        at = channel * WIDTH
        shine = load(columns, at) + load(columns, at + 4 * WIDTH)
        shine += load(columns, at + 8 * WIDTH) + load(columns, at + 12 * WIDTH)
        matt = load(room, _RED + at) * _ONE_OVER_PI * load(room, _IRRADIANCE + at)
        store(room, _RED + at, _at_least(matt + energy * shine, _ZERO))


@njit(inline="always")
def _at_least(x, low):  # type: ignore[no-untyped-def]
    """``low`` for NaN too."""
    return select(x > low, x, low)


@njit(inline="always")
def _clamped(x, high):  # type: ignore[no-untyped-def]
    """x within 0 and ``high``; 0 for NaN."""
    x = _at_least(x, _ZERO)
    return select(x < high, x, high)


@njit(inline="always")
def _store_cell(a, b, rows, columns, room):  # type: ignore[no-untyped-def]
    """Where (a, b) lies among so many rows and columns of nodes: the cell's first corner and all corners' shares."""
    a, b = _clamped(a, np.float32(rows - 1)), _clamped(b, np.float32(columns - 1))
    row, column = whole(_clamped(a, np.float32(rows - 2))), whole(_clamped(b, np.float32(columns - 2)))
    t, s = a - row, b - column
    store(room, _ROW, row)
    store(room, _COLUMN, column)
    store(room, _S, s)
    store(room, _T, t)
    store(room, _W00, (_ONE - t) * (_ONE - s))
    store(room, _W01, (_ONE - t) * s)
    store(room, _W10, t * (_ONE - s))
    store(room, _W11, t * s)


@njit(inline="always")
def _four_corners(table, at, right, down, room, k):  # type: ignore[no-untyped-def]
    """Gaussian k's mean of the four rows of sixteen at its cell's corners."""
    upper = spread(room, _W00 + k) * load(table, at) + spread(room, _W01 + k) * load(table, at + right)
    at += down
    return upper + (
        spread(room, _W10 + k) * load(table, at) + spread(room, _W11 + k) * load(table, at + right)
    )


@njit(inline="always")
def _place_in_lobes(roughness, n_dot_v, room):  # type: ignore[no-untyped-def]
    """See :func:`.specular_lobe.lobe_table`."""
    a = (roughness - ROUGHNESS_LOW) / ROUGHNESS_SPAN * np.float32(ROUGHNESS_COUNT - 1)
    b = root(_clamped(magnitude(n_dot_v), _ONE))
    b = (select(n_dot_v < _ZERO, _ZERO - b, b) + _ONE) * np.float32(0.5 * (COSINE_COUNT - 1))
    _store_cell(a, b, ROUGHNESS_COUNT, COSINE_COUNT, room)


@njit(inline="always")
def _place_in_square(x, y, z, size, room):  # type: ignore[no-untyped-def]
    """See :func:`.shading_tables.octahedral_nodes`."""
    scale = _ONE / _at_least(magnitude(x) + magnitude(y) + magnitude(z), _TINY)
    a, b = x * scale, y * scale
    below = z < _ZERO
    folded_a, folded_b = _ONE - magnitude(b), _ONE - magnitude(a)
    folded_a = select(a < _ZERO, _ZERO - folded_a, folded_a)
    folded_b = select(b < _ZERO, _ZERO - folded_b, folded_b)
    a, b = select(below, folded_a, a), select(below, folded_b, b)
    half = np.float32(0.5 * (size - 1))
    _store_cell((b + _ONE) * half, (a + _ONE) * half, size, size, room)


@njit(inline="always")
def _mean_direction(lobe, normal, view, n_dot_v):  # type: ignore[no-untyped-def]
    """Unit directions of the lobes, whose shares along mirrored tangent and normal stand in ``lobe``."""
    (nx, ny, nz), (vx, vy, vz) = normal, view
    # the tangent away from the camera; in a view along the normal there is none, and none is needed
    tx, ty, tz = n_dot_v * nx - vx, n_dot_v * ny - vy, n_dot_v * nz - vz
    along_tangent = load(lobe, WIDTH) / _at_least(root(tx * tx + ty * ty + tz * tz), _TINY)
    along_normal = load(lobe, 2 * WIDTH)
    x, y, z = (
        along_normal * nx + along_tangent * tx,
        along_normal * ny + along_tangent * ty,
        along_normal * nz + along_tangent * tz,
    )
    scale = _ONE / _at_least(root(x * x + y * y + z * z), _TINY)
    return x * scale, y * scale, z * scale


@njit(inline="always")
def _open_share(root_to_light, mean, shrink, visibility):  # type: ignore[no-untyped-def]
    """Visibility averaged over the lobe, from its coefficients [16, lanes]."""
    basis = _sh_columns(*transposed(root_to_light, mean[0], mean[1], mean[2]))
    first = load(visibility, WIDTH) * basis[1] + load(visibility, 2 * WIDTH) * basis[2]
    first += load(visibility, 3 * WIDTH) * basis[3]
    second = load(visibility, 4 * WIDTH) * basis[4] + load(visibility, 5 * WIDTH) * basis[5]
    second += load(visibility, 6 * WIDTH) * basis[6] + load(visibility, 7 * WIDTH) * basis[7]
    second += load(visibility, 8 * WIDTH) * basis[8]
    third = load(visibility, 9 * WIDTH) * basis[9] + load(visibility, 10 * WIDTH) * basis[10]
    third += load(visibility, 11 * WIDTH) * basis[11] + load(visibility, 12 * WIDTH) * basis[12]
    third += load(visibility, 13 * WIDTH) * basis[13] + load(visibility, 14 * WIDTH) * basis[14]
    third += load(visibility, 15 * WIDTH) * basis[15]
    return load(visibility, 0) * basis[0] + shrink[0] * first + shrink[1] * second + shrink[2] * third


@njit(parallel=True, nogil=True, cache=True)
def turned(diffuse, turn):  # type: ignore[no-untyped-def]
    """Diffuse tables [33·33, 3·16] that take coefficients before ``turn`` [16, 16]: 3 267 rows instead of N.

    In numba, since a BLAS product would leave threads spinning that slow the look-up threefold.
    """
    result = np.empty_like(diffuse)
    for i in prange(len(diffuse)):
        for at in range(i * 3 * WIDTH, (i + 1) * 3 * WIDTH, WIDTH):
            row = lanes(_ZERO)
            for source in range(WIDTH):
                row += spread(diffuse, at + source) * load(turn, source * WIDTH)
            store(result, at, row)
    return result


@njit(inline="always")
def transposed(r, x, y, z):  # type: ignore[no-untyped-def]
    """Rᵀ (x, y, z), of scalars or lanes."""
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )
