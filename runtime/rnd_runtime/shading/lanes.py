"""Shared kernels that shade sixteen Gaussians at a time: gathering, table look-ups, specular lobes.

Cells of tables are found in lanes, one Gaussian each. Table rows have sixteen numbers: a look-up loads rows for one
Gaussian, and a transpose makes them lanes of Gaussians again.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rnd_runtime.core.simd.arithmetic import at_least, floor, magnitude, select, sqrt
from rnd_runtime.core.simd.memory import broadcast, load, store, transpose
from rnd_runtime.core.simd.vectors import WIDTH

from .brdf import ROUGHNESS_RANGE
from .specular_lobe import COSINE_COUNT, ROUGHNESS_COUNT

CHUNK = 512  # Gaussians per unit of parallel work
ZERO, ONE = np.float32(0), np.float32(1)
TINY = np.float32(1e-12)
ROUGHNESS_LOW = np.float32(ROUGHNESS_RANGE[0])
ROUGHNESS_SPAN = np.float32(ROUGHNESS_RANGE[1] - ROUGHNESS_RANGE[0])
ONE_OVER_PI = np.float32(1 / np.pi)

# Rows of sixteen in a thread's scratch: inputs, radiance over the albedo, table cells
(NORMAL, VIEW, ALBEDO) = (0, 3 * WIDTH, 6 * WIDTH)  # three each, one after the other
RADIANCE = ALBEDO
ROUGHNESS = 9 * WIDTH
_GATHERED = 10 * WIDTH
(ROW, COLUMN, S, T, _W00, _W01, _W10, _W11) = (WIDTH * k for k in range(10, 18))  # see store_cell
FREE = 18 * WIDTH


@njit(error_model="numpy")
def gather(first, last, visible, surfaces, camera, indices, scratch):  # type: ignore[no-untyped-def]
    """Gather the next sixteen ``visible`` [N] Gaussians from ``first`` on; return the next position and the count.

    ``surfaces``: means, normals, albedo, roughness, visibility. Fewer than sixteen are padded with the first.
    """
    means, normals, albedo, roughness, _ = surfaces
    i, k = first, 0
    while i < last and k < WIDTH:
        if visible[i]:
            for axis in range(3):
                scratch[NORMAL + axis * WIDTH + k] = normals[i, axis]
                scratch[VIEW + axis * WIDTH + k] = camera[axis] - means[i, axis]
                scratch[ALBEDO + axis * WIDTH + k] = albedo[i, axis]
            scratch[ROUGHNESS + k] = roughness[i]
            indices[k] = i
            k += 1
        i += 1
    count = k
    for k in range(count, WIDTH):
        indices[k] = indices[0]
        for at in range(0, _GATHERED, WIDTH):
            scratch[at + k] = scratch[at]
    return i, count


@njit(inline="always")
def scatter(count, indices, scratch, radiance):  # type: ignore[no-untyped-def]
    """Write the gathered Gaussians' radiance [N, 3]."""
    for k in range(count):
        for channel in range(3):
            radiance[indices[k], channel] = scratch[RADIANCE + channel * WIDTH + k]


@njit(inline="always")
def load3(scratch, at):  # type: ignore[no-untyped-def]
    """Three rows from ``at`` on."""
    return load(scratch, at), load(scratch, at + WIDTH), load(scratch, at + 2 * WIDTH)


@njit(inline="always")
def unit(v):  # type: ignore[no-untyped-def]
    x, y, z = v
    scale = ONE / at_least(sqrt(x * x + y * y + z * z), TINY)
    return x * scale, y * scale, z * scale


@njit(inline="always")
def visibility_in_lanes(indices, visibility, rows, columns):  # type: ignore[no-untyped-def]
    """Coefficients [N, 16] of sixteen Gaussians as [16, lanes] in ``columns``."""
    for k in range(WIDTH):
        store(rows, k * WIDTH, load(visibility, indices[k] * WIDTH))
    transpose(rows, columns)


@njit(inline="always")
def nan_lanes(scratch, visibility):  # type: ignore[no-untyped-def]
    """NaN in lanes of Gaussians with a non-finite number, which ``at_least`` may drop, else 0.

    Covers the gathered inputs in ``scratch`` and the visibility [16, lanes].
    """
    sum_of_all = load(scratch, 0)
    for at in range(WIDTH, _GATHERED, WIDTH):
        sum_of_all += load(scratch, at)
    for at in range(0, WIDTH * WIDTH, WIDTH):
        sum_of_all += load(visibility, at)
    return sum_of_all - sum_of_all


@njit(inline="always")
def lobes_in_lanes(lobes, n_dot_v, scratch, rows, columns):  # type: ignore[no-untyped-def]
    """The sixteen columns of ``lobes`` [16, 49, 16] at each Gaussian's roughness and n·v, in ``columns``."""
    a = (load(scratch, ROUGHNESS) - ROUGHNESS_LOW) / ROUGHNESS_SPAN * np.float32(ROUGHNESS_COUNT - 1)
    b = sqrt(clamped(magnitude(n_dot_v), ONE))
    b = (select(n_dot_v < ZERO, ZERO - b, b) + ONE) * np.float32(0.5 * (COSINE_COUNT - 1))
    store_cell(a, b, ROUGHNESS_COUNT, COSINE_COUNT, scratch)
    for k in range(WIDTH):
        at = (int(scratch[ROW + k]) * COSINE_COUNT + int(scratch[COLUMN + k])) * WIDTH
        store(rows, k * WIDTH, four_corners(lobes, at, WIDTH, COSINE_COUNT * WIDTH, scratch, k))
    transpose(rows, columns)


@njit(inline="always")
def lobe_direction(lobe, normal, view, n_dot_v):  # type: ignore[no-untyped-def]
    """Unit directions of the lobes from their shares along mirrored tangent and normal in ``lobe``."""
    (nx, ny, nz), (vx, vy, vz) = normal, view
    # the tangent away from the camera; 0 in a view along the normal
    tx, ty, tz = n_dot_v * nx - vx, n_dot_v * ny - vy, n_dot_v * nz - vz
    along_tangent = load(lobe, WIDTH) / at_least(sqrt(tx * tx + ty * ty + tz * tz), TINY)
    along_normal = load(lobe, 2 * WIDTH)
    x, y, z = (
        along_normal * nx + along_tangent * tx,
        along_normal * ny + along_tangent * ty,
        along_normal * nz + along_tangent * tz,
    )
    return unit((x, y, z))


@njit(inline="always")
def clamped(x, high):  # type: ignore[no-untyped-def]
    """x clamped to [0, ``high``]; 0 for NaN."""
    x = at_least(x, ZERO)
    return select(x < high, x, high)


@njit(inline="always")
def store_cell(a, b, rows, columns, scratch):  # type: ignore[no-untyped-def]
    """Cell of (a, b) in a grid of ``rows`` × ``columns`` nodes: its first corner and all corners' weights."""
    a, b = clamped(a, np.float32(rows - 1)), clamped(b, np.float32(columns - 1))
    row, column = floor(clamped(a, np.float32(rows - 2))), floor(clamped(b, np.float32(columns - 2)))
    t, s = a - row, b - column
    store(scratch, ROW, row)
    store(scratch, COLUMN, column)
    store(scratch, S, s)
    store(scratch, T, t)
    store(scratch, _W00, (ONE - t) * (ONE - s))
    store(scratch, _W01, (ONE - t) * s)
    store(scratch, _W10, t * (ONE - s))
    store(scratch, _W11, t * s)


@njit(inline="always")
def four_corners(table, at, right, down, scratch, k):  # type: ignore[no-untyped-def]
    """Gaussian k's weighted mean of the four rows of sixteen at its cell's corners."""
    upper = broadcast(scratch, _W00 + k) * load(table, at) + broadcast(scratch, _W01 + k) * load(table, at + right)
    at += down
    return upper + (
        broadcast(scratch, _W10 + k) * load(table, at) + broadcast(scratch, _W11 + k) * load(table, at + right)
    )


@njit(inline="always")
def transposed(r, v):  # type: ignore[no-untyped-def]
    """Rᵀ v."""
    x, y, z = v
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )
