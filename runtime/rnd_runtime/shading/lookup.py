"""Shading from tables, sixteen Gaussians at a time (numba, sixteen lanes); the tables: ``.tables``."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from rnd_runtime.core.simd.arithmetic import at_least, floor, lanes, magnitude, reduce_add, select
from rnd_runtime.core.simd.memory import aligned_floats, broadcast, load, store, transpose
from rnd_runtime.core.simd.vectors import WIDTH
from rnd_runtime.shading.sh import compiled_sh_columns

from .brdf import specular_share_lanes
from .lanes import (
    ALBEDO,
    CHUNK,
    COLUMN,
    FREE,
    NORMAL,
    ONE,
    ONE_OVER_PI,
    RADIANCE,
    ROW,
    TINY,
    VIEW,
    ZERO,
    S,
    T,
    clamped,
    four_corners,
    gather,
    load3,
    lobe_direction,
    lobes_in_lanes,
    nan_lanes,
    scatter,
    store_cell,
    transposed,
    unit,
    visibility_in_lanes,
)

DIFFUSE_SIZE = 33  # nodes along the square, 6° apart
SPECULAR_SIZE = 49

# A row of the specular table: RGB and 0 of a cell's corners (0, 0), (1, 0), (0, 1) and (1, 1) in (s, t). A corner's
# weight is (s or 1 − s)(t or 1 − t) = (constant + slope · s)(constant + slope · t).
_SIGNS = np.array([-1, 1], np.float32)
_S_SLOPE = np.tile(np.repeat(_SIGNS, 4), 2)
_T_SLOPE = np.repeat(_SIGNS, 8)
_S_CONSTANT, _T_CONSTANT = np.maximum(-_S_SLOPE, 0), np.maximum(-_T_SLOPE, 0)

(_LEVEL, _UP) = (FREE, FREE + WIDTH)  # rows of scratch
_IRRADIANCE = FREE + 2 * WIDTH  # three
_SCRATCH = FREE + 5 * WIDTH


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def shade_from_tables(surfaces, camera, rotations, tables, visible, radiance):  # type: ignore[no-untyped-def]
    """Fill ``radiance`` [N, 3] of the Gaussians ``visible`` [N].

    Args:
        surfaces: means [N, 3] m, normals [N, 3], albedo [N, 3], roughness [N] and visibility [N, 16].
        camera: [3] m.
        rotations: light → world and root → light, [3, 3] each.
        tables: diffuse [33·33, 3·16] for visibility in the root's frame; specular [49·49, 7, 16] of cells; lobes
            [16, 49, 16].
    """
    for chunk in prange((len(visible) + CHUNK - 1) // CHUNK):
        indices, scratch = np.empty(WIDTH, np.int64), aligned_floats(_SCRATCH)
        rows, columns = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        i, last = chunk * CHUNK, min((chunk + 1) * CHUNK, len(visible))
        while i < last:
            i, count = gather(i, last, visible, surfaces, camera, indices, scratch)
            if count > 0:
                _shade_sixteen(indices, surfaces[4], rotations, tables, scratch, rows, columns)
                scatter(count, indices, scratch, radiance)


@njit(error_model="numpy")
def _shade_sixteen(indices, visibility, rotations, tables, scratch, rows, columns):  # type: ignore[no-untyped-def]
    """Radiance, written over the albedo in ``scratch``; ``rows`` and ``columns`` [16, 16] are scratch."""
    light_to_world, root_to_light = rotations
    diffuse, specular, lobes = tables
    normal = transposed(light_to_world, load3(scratch, NORMAL))
    view = unit(transposed(light_to_world, load3(scratch, VIEW)))
    n_dot_v = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]

    lobes_in_lanes(lobes, n_dot_v, scratch, rows, columns)
    energy, level_position = load(columns, 0), load(columns, 3 * WIDTH)
    mean = lobe_direction(columns, normal, view, n_dot_v)
    shrink = load3(columns, 4 * WIDTH)
    visibility_in_lanes(indices, visibility, rows, columns)
    broken = nan_lanes(scratch, columns)
    energy = energy * specular_share_lanes(*load3(scratch, ALBEDO))
    energy = energy * at_least(_mean_visibility(root_to_light, mean, shrink, columns), ZERO)

    _octahedral_cell(mean[0], mean[1], mean[2], SPECULAR_SIZE, scratch)
    levels = specular.shape[1]
    level = floor(clamped(level_position, np.float32(levels - 2)))
    store(scratch, _LEVEL, level)
    store(scratch, _UP, level_position - level)
    s_slope, s_constant = load(_S_SLOPE, 0), load(_S_CONSTANT, 0)
    t_slope, t_constant = load(_T_SLOPE, 0), load(_T_CONSTANT, 0)
    for k in range(WIDTH):
        cell = int(scratch[ROW + k]) * SPECULAR_SIZE + int(scratch[COLUMN + k])
        at = (cell * levels + int(scratch[_LEVEL + k])) * WIDTH
        lower, upper = load(specular, at), load(specular, at + WIDTH)
        share = (s_constant + s_slope * scratch[S + k]) * (t_constant + t_slope * scratch[T + k])
        store(rows, k * WIDTH, share * (lower + scratch[_UP + k] * (upper - lower)))
    transpose(rows, columns)

    _octahedral_cell(normal[0], normal[1], normal[2], DIFFUSE_SIZE, scratch)
    row = 3 * WIDTH  # of one node
    for k in range(WIDTH):
        at = (int(scratch[ROW + k]) * DIFFUSE_SIZE + int(scratch[COLUMN + k])) * row
        coefficients = load(visibility, indices[k] * WIDTH)
        for channel in range(3):
            met = four_corners(diffuse, at + channel * WIDTH, row, DIFFUSE_SIZE * row, scratch, k)
            scratch[_IRRADIANCE + channel * WIDTH + k] = reduce_add(coefficients * met)

    for channel in range(3):
        at = channel * WIDTH
        specular_part = load(columns, at) + load(columns, at + 4 * WIDTH)
        specular_part += load(columns, at + 8 * WIDTH) + load(columns, at + 12 * WIDTH)
        diffuse_part = load(scratch, ALBEDO + at) * ONE_OVER_PI * load(scratch, _IRRADIANCE + at)
        store(scratch, RADIANCE + at, at_least(diffuse_part + energy * specular_part, ZERO) + broken)


@njit(inline="always")
def _octahedral_cell(x, y, z, size, scratch):  # type: ignore[no-untyped-def]
    """Cell of a direction on the grid of ``.tables.octahedral_nodes``."""
    scale = ONE / at_least(magnitude(x) + magnitude(y) + magnitude(z), TINY)
    a, b = x * scale, y * scale
    below = z < ZERO
    folded_a, folded_b = ONE - magnitude(b), ONE - magnitude(a)
    folded_a = select(a < ZERO, ZERO - folded_a, folded_a)
    folded_b = select(b < ZERO, ZERO - folded_b, folded_b)
    a, b = select(below, folded_a, a), select(below, folded_b, b)
    half = np.float32(0.5 * (size - 1))
    store_cell((b + ONE) * half, (a + ONE) * half, size, size, scratch)


@njit(inline="always")
def _mean_visibility(root_to_light, mean, shrink, visibility):  # type: ignore[no-untyped-def]
    """Visibility averaged over the lobe, from its coefficients [16, lanes]."""
    basis = compiled_sh_columns(*transposed(root_to_light, mean))
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
def rotated(diffuse, rotation):  # type: ignore[no-untyped-def]
    """Diffuse tables [33·33, 3·16] for coefficients before ``rotation`` [16, 16].

    Compiled: idle BLAS threads spin and slow the look-up threefold.
    """
    result = np.empty_like(diffuse)
    for i in prange(len(diffuse)):
        for at in range(i * 3 * WIDTH, (i + 1) * 3 * WIDTH, WIDTH):
            row = lanes(ZERO)
            for source in range(WIDTH):
                row += broadcast(diffuse, at + source) * load(rotation, source * WIDTH)
            store(result, at, row)
    return result
