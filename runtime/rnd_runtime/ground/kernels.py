"""Compiled projection of spheres onto the ground, and its look-up by pixel."""

from __future__ import annotations

import numba
import numpy as np

_FAST = {"reassoc", "contract", "arcp", "nsz"}


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def project(centres, radii, normal, origin, offset, along, across, directions, shares, blur, starts, out):  # type: ignore[no-untyped-def]
    """Add each direction's share times its coverage by projected spheres to ``out`` [I, J, 3].

    ``along`` and ``across`` are cells per metre. Spheres starts[b] to starts[b + 1] are of one height; their
    coverage is averaged over a square of ± ``blur`` times their distance to the ground, which keeps its sum.
    """
    rows, columns = out.shape[:2]
    parts = min(4, directions.shape[0])
    sums = np.zeros((parts, rows, columns, 3), np.float32)
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    cells_along = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    cells_across = np.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    edge = half * (one / cells_along + one / cells_across)
    start_i = along[0] * origin[0] + along[1] * origin[1] + along[2] * origin[2]
    start_j = across[0] * origin[0] + across[1] * origin[1] + across[2] * origin[2]
    for part in numba.prange(parts):
        covered, free = np.zeros((rows, columns), np.float32), np.ones((rows, columns), np.float32)
        line = np.zeros(max(rows, columns), np.float32)
        for k in range(part, directions.shape[0], parts):
            dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
            sine = dx * normal[0] + dy * normal[1] + dz * normal[2]
            # the direction's azimuth in the grid's axes, unit
            azimuth_i = (along[0] * dx + along[1] * dy + along[2] * dz) / cells_along
            azimuth_j = (across[0] * dx + across[1] * dy + across[2] * dz) / cells_across
            length = np.sqrt(azimuth_i * azimuth_i + azimuth_j * azimuth_j)
            if length > np.float32(1e-6):
                azimuth_i, azimuth_j = azimuth_i / length, azimuth_j / length
            else:
                azimuth_i, azimuth_j = one, zero
            all_i0, all_i1, all_j0, all_j1 = rows, 0, columns, 0
            for band in range(starts.shape[0] - 1):
                i0, i1, j0, j1 = rows, 0, columns, 0
                heights = zero
                for s in range(starts[band], starts[band + 1]):
                    x, y, z = centres[s, 0], centres[s, 1], centres[s, 2]
                    height = max(x * normal[0] + y * normal[1] + z * normal[2] - offset, zero)
                    heights += height
                    distance = height / sine
                    x, y, z = x - distance * dx, y - distance * dy, z - distance * dz
                    place_i = x * along[0] + y * along[1] + z * along[2] - start_i
                    place_j = x * across[0] + y * across[1] + z * across[2] - start_j
                    reach = radii[s] + half * edge
                    stretched = reach / sine
                    reach_i = np.sqrt((stretched * azimuth_i) ** 2 + (reach * azimuth_j) ** 2) * cells_along
                    reach_j = np.sqrt((stretched * azimuth_j) ** 2 + (reach * azimuth_i) ** 2) * cells_across
                    first_i, last_i = max(int(place_i - reach_i), 0), min(int(place_i + reach_i) + 1, rows)
                    first_j, last_j = max(int(place_j - reach_j), 0), min(int(place_j + reach_j) + 1, columns)
                    if first_i >= last_i or first_j >= last_j:
                        continue
                    i0, i1, j0, j1 = min(i0, first_i), max(i1, last_i), min(j0, first_j), max(j1, last_j)
                    for i in range(first_i, last_i):
                        a = (np.float32(i) + half - place_i) / cells_along
                        for j in range(first_j, last_j):
                            b = (np.float32(j) + half - place_j) / cells_across
                            forward = (a * azimuth_i + b * azimuth_j) * sine
                            sideways = b * azimuth_i - a * azimuth_j
                            inside = (reach - np.sqrt(forward * forward + sideways * sideways)) / edge
                            covered[i, j] = max(covered[i, j], min(inside, one))
                if i0 >= i1:
                    continue
                spread = blur * heights / (np.float32(starts[band + 1] - starts[band]) * sine)
                wide_i, wide_j = int(spread * cells_along + half), int(spread * cells_across + half)
                i0, i1 = max(i0 - wide_i, 0), min(i1 + wide_i, rows)
                j0, j1 = max(j0 - wide_j, 0), min(j1 + wide_j, columns)
                if wide_i > 0:
                    for j in range(j0, j1):
                        _average(covered[i0:i1, j], wide_i, line)
                if wide_j > 0:
                    for i in range(i0, i1):
                        _average(covered[i, j0:j1], wide_j, line)
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        free[i, j] *= one - covered[i, j]
                        covered[i, j] = zero
                all_i0, all_i1 = min(all_i0, i0), max(all_i1, i1)
                all_j0, all_j1 = min(all_j0, j0), max(all_j1, j1)
            for i in range(all_i0, all_i1):
                for j in range(all_j0, all_j1):
                    for c in range(3):
                        sums[part, i, j, c] += shares[k, c] * (one - free[i, j])
                    free[i, j] = one
    for i in numba.prange(rows):
        for part in range(parts):
            out[i] += sums[part, i]


@numba.njit(inline="always", error_model="numpy")
def _average(values, width, line):  # type: ignore[no-untyped-def]
    """Replace ``values`` by their means over ± ``width``; ``line`` is room for them."""
    count = values.shape[0]
    total = np.float32(0)
    share = np.float32(1) / np.float32(2 * width + 1)
    for k in range(min(width, count)):
        total += values[k]
    for k in range(count):
        if k + width < count:
            total += values[k + width]
        if k - width - 1 >= 0:
            total -= values[k - width - 1]
        line[k] = total * share
    for k in range(count):
        values[k] = max(line[k], np.float32(0))


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def look_up(rays, eye, normal, offset, inverse, start, values, remaining):  # type: ignore[no-untyped-def]
    """Subtract the blocked share at every pixel, bilinear, 0 outside of the grid."""
    rows, columns = values.shape[:2]
    above = offset - (normal[0] * eye[0] + normal[1] * eye[1] + normal[2] * eye[2])
    for row in numba.prange(remaining.shape[0]):
        for column in range(remaining.shape[1]):
            u, v = column + 0.5, row + 0.5
            dx = u * rays[0, 0] + v * rays[1, 0] + rays[2, 0]
            dy = u * rays[0, 1] + v * rays[1, 1] + rays[2, 1]
            dz = u * rays[0, 2] + v * rays[1, 2] + rays[2, 2]
            t = above / (dx * normal[0] + dy * normal[1] + dz * normal[2])
            if not t > 0:
                continue
            x, y, z = eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz
            i = inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2] * z - start[0]
            j = inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2] * z - start[1]
            if not (0 <= i < rows - 1 and 0 <= j < columns - 1):
                continue
            i0, j0 = int(i), int(j)
            a, b = np.float32(i - i0), np.float32(j - j0)
            for c in range(3):
                near = values[i0, j0, c] * (1 - b) + values[i0, j0 + 1, c] * b
                far = values[i0 + 1, j0, c] * (1 - b) + values[i0 + 1, j0 + 1, c] * b
                remaining[row, column, c] -= near * (1 - a) + far * a
