"""Shading by tables that depend on the light alone (Sloan et al. 2002, per normal instead of per point).

With linear visibility v(ω) = Σ_j v_j Y_j(ω) the diffuse irradiance is Σ_j v_j M_j(n),

    M_j(n) = Σ_k L_k Δω_k Y_j(ω_k) max(n·ω_k, 0),

sixteen colours over the normal: exact in the light's frequency, one fetch and a dot product per Gaussian. The
specular part is E · L̄(mean, width) · v̄(mean, width): the lobe's energy, the light prefiltered by the lobe of
``specular_lobe`` and the visibility averaged over the same lobe, which for spherical harmonics is one factor a
degree. Tables live in the light probe's frame on octahedral grids; turning the light turns normals instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._lanes import WIDTH, load, total
from ._raster_input import floats, mask
from .brdf import ROUGHNESS_RANGE
from .gaussians import Gaussians
from .light import Light, texel_directions, texel_solid_angles
from .sh import SH_COUNT, sh_basis, sh_columns, sh_rotation
from .specular_lobe import LOBE_WIDTHS, lobe_table

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

DIFFUSE_SIZE = 33  # nodes along the square: 6°, where M_j bends over 5° at the sharpest
SPECULAR_SIZE = 49
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_ONE_OVER_PI = np.float32(1 / np.pi)
_TINY = np.float32(1e-12)
_ROUGHNESS_LOW = np.float32(ROUGHNESS_RANGE[0])
_ROUGHNESS_SPAN = np.float32(ROUGHNESS_RANGE[1] - ROUGHNESS_RANGE[0])


@dataclass(frozen=True, eq=False)
class SkyTables:
    """What a light probe does to diffuse and to specular surfaces, ready to be looked up.

    Attributes:
        diffuse: [33·33, 3·16] M_j(n) at the nodes of an octahedral grid over n.
        specular: [7, 49·49, 3] mean radiance under lobes of LOBE_WIDTHS around each node.
    """

    diffuse: Floats32
    specular: Floats32

    @classmethod
    def build(cls, light: Light, texels: tuple[int, int]) -> SkyTables:
        """For ``light`` downsized to ``texels`` (height, width)."""
        directions = texel_directions(*texels).reshape(-1, 3).astype(np.float32)
        solid_angles = texel_solid_angles(*texels).reshape(-1, 1).astype(np.float32)
        radiance = light.resized(*texels).radiance.reshape(-1, 3)
        weighted = (radiance * solid_angles)[:, :, None] * sh_basis(directions)[:, None, :]  # [K, 3, 16]
        cosines = np.maximum(octahedral_nodes(DIFFUSE_SIZE) @ directions.T, 0)
        diffuse = cosines @ weighted.reshape(len(directions), 3 * SH_COUNT)
        nodes = octahedral_nodes(SPECULAR_SIZE)
        specular = np.empty((len(LOBE_WIDTHS), len(nodes), 3), np.float32)
        texel_rows = np.concatenate([directions, solid_angles, radiance * solid_angles], axis=1)
        _prefilter(nodes, np.ascontiguousarray(texel_rows.T), LOBE_WIDTHS.astype(np.float32), specular)
        return cls(diffuse, specular)

    def shade(
        self,
        gaussians: Gaussians,
        camera_position: ArrayLike,
        light_to_world: Floats,
        seen: ArrayLike | None = None,
    ) -> Floats32:
        """Linear radiance [N, 3] towards the camera, close to ``shade_reference``; 0 where not ``seen``."""
        root_to_light = light_to_world.T @ np.asarray(gaussians.root_rotation, np.float64)
        radiance = np.zeros((len(gaussians.means), 3), np.float32)
        _look_up(
            floats(gaussians.means),
            floats(gaussians.normals),
            floats(gaussians.albedo),
            floats(gaussians.roughness),
            floats(gaussians.visibility),
            np.array(camera_position, np.float32),
            tuple(np.array(r, np.float32, order="C") for r in (light_to_world, root_to_light)),
            (
                _turned(self.diffuse, sh_rotation(root_to_light).astype(np.float32)),
                self.specular,
                lobe_table(),
            ),
            mask(seen, len(radiance)),
            radiance,
        )
        return radiance


@cache
def octahedral_nodes(size: int) -> Floats32:
    """Unit directions [size², 3] of the nodes of a square grid folded into an octahedron.

    Nodes lie on the square's edges too, so a bilinear lookup never leaves it and no border is needed
    (Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors").
    """
    line = np.linspace(-1, 1, size)
    b, a = np.meshgrid(line, line, indexing="ij")
    c = 1 - np.abs(a) - np.abs(b)
    fold = np.maximum(-c, 0)
    nodes = np.stack([a - np.copysign(fold, a), b - np.copysign(fold, b), c], axis=-1)
    return np.asarray((nodes / np.linalg.norm(nodes, axis=-1, keepdims=True)).reshape(-1, 3), np.float32)


@numba.njit(inline="always")
def octahedral_cell(x, y, z, size):  # type: ignore[no-untyped-def]
    """Node index of the cell's corner for a direction of any length, and the place (s, t) within the cell."""
    scale = _ONE / max(abs(x) + abs(y) + abs(z), _TINY)
    a, b = x * scale, y * scale
    if z < 0:
        a, b = (_ONE - abs(b)) * (_ONE if a >= 0 else -_ONE), (_ONE - abs(a)) * (_ONE if b >= 0 else -_ONE)
    a, b = (a + _ONE) * _HALF * np.float32(size - 1), (b + _ONE) * _HALF * np.float32(size - 1)
    column, row = min(max(int(a), 0), size - 2), min(max(int(b), 0), size - 2)
    return row * size + column, a - np.float32(column), b - np.float32(row)


@numba.njit(parallel=True, cache=True, fastmath=True, error_model="numpy")
def _prefilter(nodes, texels, widths, specular):  # type: ignore[no-untyped-def]
    """Mean radiance under 1/(1 + width − cos)²; ``texels`` [7, K]: direction, solid angle, flux."""
    for i in numba.prange(len(nodes)):
        x, y, z = nodes[i, 0], nodes[i, 1], nodes[i, 2]
        for level in range(len(widths)):
            top = _ONE + widths[level]
            total, red, green, blue = _ZERO, _ZERO, _ZERO, _ZERO
            for k in range(texels.shape[1]):
                away = top - (x * texels[0, k] + y * texels[1, k] + z * texels[2, k])
                weight = _ONE / (away * away)
                total += weight * texels[3, k]
                red += weight * texels[4, k]
                green += weight * texels[5, k]
                blue += weight * texels[6, k]
            specular[level, i, 0] = red / total
            specular[level, i, 1] = green / total
            specular[level, i, 2] = blue / total


_sh_columns = numba.njit(sh_columns)


@numba.njit(
    parallel=True,
    nogil=True,
    cache=True,
    fastmath={"reassoc", "contract", "arcp", "nsz"},
    error_model="numpy",
)
def _look_up(  # type: ignore[no-untyped-def]
    means, normals, albedo, roughness, visibility, camera, rotations, tables, seen, radiance
):
    light_to_world, root_to_light = rotations
    diffuse, specular, lobes = tables
    for i in numba.prange(len(means)):
        if not seen[i]:
            continue
        nx, ny, nz = transposed(light_to_world, normals[i, 0], normals[i, 1], normals[i, 2])
        vx, vy, vz = camera[0] - means[i, 0], camera[1] - means[i, 1], camera[2] - means[i, 2]
        vx, vy, vz = transposed(light_to_world, vx, vy, vz)
        distance = max(np.sqrt(vx * vx + vy * vy + vz * vz), _TINY)
        vx, vy, vz = vx / distance, vy / distance, vz / distance
        n_dot_v = nx * vx + ny * vy + nz * vz
        energy, mx, my, mz, place, shrink1, shrink2, shrink3 = lobe_at(
            lobes, roughness[i], n_dot_v, nx, ny, nz, vx, vy, vz
        )
        basis = _sh_columns(*transposed(root_to_light, mx, my, mz))
        open_share = visibility[i, 0] * np.float32(basis[0])  # v averaged over the lobe
        for j in range(1, 16):
            shrink = shrink1 if j < 4 else (shrink2 if j < 9 else shrink3)
            open_share += shrink * visibility[i, j] * np.float32(basis[j])

        low = min(int(place), len(specular) - 2)
        up = place - np.float32(low)
        cell, s, t = octahedral_cell(mx, my, mz, SPECULAR_SIZE)
        node, ns, nt = octahedral_cell(nx, ny, nz, DIFFUSE_SIZE)
        w00, w01, w10, w11 = (_ONE - ns) * (_ONE - nt), ns * (_ONE - nt), (_ONE - ns) * nt, ns * nt
        coefficients = load(visibility, i * WIDTH)
        row = 3 * WIDTH  # of one node
        node *= row
        for channel in range(3):
            lower = _bilinear(specular[low], cell, SPECULAR_SIZE, s, t, channel)
            upper = _bilinear(specular[low + 1], cell, SPECULAR_SIZE, s, t, channel)
            shine = energy * max(open_share, _ZERO) * (lower + up * (upper - lower))
            at = node + channel * WIDTH
            upper_nodes = w00 * load(diffuse, at) + w01 * load(diffuse, at + row)
            at += DIFFUSE_SIZE * row
            lower_nodes = w10 * load(diffuse, at) + w11 * load(diffuse, at + row)
            irradiance = total(coefficients * (upper_nodes + lower_nodes))
            radiance[i, channel] = max(albedo[i, channel] * _ONE_OVER_PI * irradiance + shine, _ZERO)


@numba.njit(parallel=True, nogil=True, cache=True, fastmath=True)
def _turned(diffuse, turn):  # type: ignore[no-untyped-def]
    """Tables that take coefficients of the root's frame: 3 267 rows to turn instead of one per Gaussian.

    In numba, since a BLAS product would leave threads spinning that slow the lookup threefold.
    """
    result = np.zeros_like(diffuse)
    for i in numba.prange(len(diffuse)):
        for channel in range(3):
            for source in range(16):
                for target in range(16):
                    result[i, channel * 16 + target] += (
                        diffuse[i, channel * 16 + source] * turn[source, target]
                    )
    return result


@numba.njit(inline="always")
def transposed(r, x, y, z):  # type: ignore[no-untyped-def]
    """Rᵀ (x, y, z)."""
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )


@numba.njit(inline="always")
def _bilinear(table, cell, size, s, t, channel):  # type: ignore[no-untyped-def]
    top = table[cell, channel] + s * (table[cell + 1, channel] - table[cell, channel])
    cell += size
    bottom = table[cell, channel] + s * (table[cell + 1, channel] - table[cell, channel])
    return top + t * (bottom - top)


@numba.njit(cache=True, error_model="numpy")
def lobe_at(lobes, roughness, n_dot_v, nx, ny, nz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """``lobe_table`` between its nodes: energy, mean direction (x, y, z), place among the widths, attenuations."""
    rows, columns = lobes.shape[0] - 1, lobes.shape[1] - 1
    a = min(max((roughness - _ROUGHNESS_LOW) / _ROUGHNESS_SPAN, _ZERO), _ONE) * np.float32(rows)
    root = np.sqrt(min(abs(n_dot_v), _ONE))
    b = ((root if n_dot_v >= 0 else -root) + _ONE) * _HALF * np.float32(columns)
    i, j = min(int(a), rows - 1), min(int(b), columns - 1)
    s, t = a - np.float32(i), b - np.float32(j)
    w00, w01, w10, w11 = (_ONE - s) * (_ONE - t), (_ONE - s) * t, s * (_ONE - t), s * t
    c00, c01, c10, c11 = lobes[i, j], lobes[i, j + 1], lobes[i + 1, j], lobes[i + 1, j + 1]
    along_tangent = w00 * c00[1] + w01 * c01[1] + w10 * c10[1] + w11 * c11[1]
    along_normal = w00 * c00[2] + w01 * c01[2] + w10 * c10[2] + w11 * c11[2]
    # the tangent away from the camera; in a view along the normal there is none, and none is needed
    tx, ty, tz = n_dot_v * nx - vx, n_dot_v * ny - vy, n_dot_v * nz - vz
    along_tangent /= max(np.sqrt(tx * tx + ty * ty + tz * tz), _TINY)
    mx, my, mz = (
        along_normal * nx + along_tangent * tx,
        along_normal * ny + along_tangent * ty,
        along_normal * nz + along_tangent * tz,
    )
    length = max(np.sqrt(mx * mx + my * my + mz * mz), _TINY)
    return (
        w00 * c00[0] + w01 * c01[0] + w10 * c10[0] + w11 * c11[0],
        mx / length,
        my / length,
        mz / length,
        w00 * c00[3] + w01 * c01[3] + w10 * c10[3] + w11 * c11[3],
        w00 * c00[4] + w01 * c01[4] + w10 * c10[4] + w11 * c11[4],
        w00 * c00[5] + w01 * c01[5] + w10 * c10[5] + w11 * c11[5],
        w00 * c00[6] + w01 * c01[6] + w10 * c10[6] + w11 * c11[6],
    )
