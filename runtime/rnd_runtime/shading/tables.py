"""Shading by tables that depend on the light alone (Sloan et al. 2002, per normal instead of per point).

With linear visibility v(ω) = Σ_j v_j Y_j(ω) the diffuse irradiance is Σ_j v_j M_j(n),

    M_j(n) = Σ_k L_k Δω_k Y_j(ω_k) max(n·ω_k, 0),

sixteen colours over the normal. The specular part is E · L̄(mean, width) · v̄(mean, width): the lobe's energy, the
light prefiltered by the lobe of ``specular_lobe``, and the visibility averaged over it, one factor per SH degree.
Tables are octahedral grids in the light probe's frame; rotating the light rotates normals instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, mask
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.simd.arithmetic import lanes, reduce_add
from rnd_runtime.core.simd.memory import load, store
from rnd_runtime.core.simd.vectors import WIDTH
from rnd_runtime.shading.sh import SH_COUNT, rotation_matrix, sh_basis, sh_quadrature

from .light import Light, texel_directions, texel_solid_angles
from .lookup import DIFFUSE_SIZE, SPECULAR_SIZE, rotated, shade_from_tables
from .specular_lobe import LOBE_WIDTHS, lobe_rows

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_ZERO, _ONE = np.float32(0), np.float32(1)


class TableArrays(NamedTuple):
    """Input of ``shade_by_tables``, see ``SkyTables``, ``lobe_rows`` and ``sh_quadrature``."""

    diffuse: Floats32  # [33·33, 3·16]
    specular: Floats32  # [49·49, 7, 16]
    lobes: Floats32  # [16, 49, 16]
    directions: Floats  # [32, 3]
    weighted: Floats  # [32, 16]


@dataclass(frozen=True, eq=False)
class SkyTables:
    """Diffuse and specular tables of a light probe.

    Attributes:
        diffuse: [33·33, 3·16] M_j(n) at the nodes of an octahedral grid over n.
        specular: [7, 49·49, 3] mean radiance under lobes of LOBE_WIDTHS around each node.
    """

    diffuse: Floats32
    specular: Floats32

    @classmethod
    def build(cls, light: Light, texels: tuple[int, int]) -> SkyTables:
        """Tables of ``light`` downsized to ``texels`` (height, width)."""
        directions = texel_directions(*texels).reshape(-1, 3).astype(np.float32)
        solid_angles = texel_solid_angles(*texels).reshape(-1, 1).astype(np.float32)
        radiance = light.resized(*texels).radiance.reshape(-1, 3)
        weighted = (radiance * solid_angles)[:, :, None] * sh_basis(directions)[:, None, :]  # [K, 3, 16]
        diffuse = np.empty((DIFFUSE_SIZE * DIFFUSE_SIZE, 3 * SH_COUNT), np.float32)
        weighted = weighted.reshape(len(directions), 3 * SH_COUNT).astype(np.float32)
        _sum_diffuse(octahedral_nodes(DIFFUSE_SIZE), directions, weighted, diffuse)
        nodes = octahedral_nodes(SPECULAR_SIZE)
        specular = np.empty((len(LOBE_WIDTHS), len(nodes), 3), np.float32)
        padded = -(-len(directions) // WIDTH) * WIDTH
        texel_columns = np.zeros((7, padded), np.float32)
        texel_columns[:, : len(directions)] = np.concatenate(
            [directions, solid_angles, radiance * solid_angles], axis=1
        ).T
        _prefilter(nodes, texel_columns, LOBE_WIDTHS.astype(np.float32), specular)
        return cls(diffuse, specular)

    def shade(
        self, gaussians: Gaussians, camera_position: ArrayLike, light_to_world: Floats, visible: ArrayLike | None = None
    ) -> Floats32:
        """Linear radiance [N, 3] towards the camera, close to ``shade_reference``; 0 where not ``visible``."""
        arrays = (gaussians.means, gaussians.normals, gaussians.albedo, gaussians.roughness, gaussians.visibility)
        radiance: Floats32 = shade_by_tables(
            tuple(floats(array) for array in arrays),
            np.array(camera_position, np.float32),
            np.array(light_to_world, np.float64, order="C"),
            np.array(gaussians.root_rotation, np.float64, order="C"),
            self.arrays,
            mask(visible, len(gaussians.means)),
        )
        return radiance

    @cached_property
    def arrays(self) -> TableArrays:
        """Kernel arrays."""
        return TableArrays(self.diffuse, self.specular_cells, lobe_rows(), *sh_quadrature())

    @cached_property
    def specular_cells(self) -> Floats32:
        """[49·49, 7, 16]: RGB and 0 of a cell's corners (0, 0), (1, 0), (0, 1), (1, 1), by its first corner."""
        nodes = self.specular.reshape(len(self.specular), SPECULAR_SIZE, SPECULAR_SIZE, 3)
        cells = np.zeros((SPECULAR_SIZE, SPECULAR_SIZE, len(nodes), 4, 4), np.float32)
        for corner in range(4):
            down, right = divmod(corner, 2)
            moved = nodes[:, down:, right:].transpose(1, 2, 0, 3)
            cells[: moved.shape[0], : moved.shape[1], :, corner, :3] = moved
        return cells.reshape(SPECULAR_SIZE * SPECULAR_SIZE, len(nodes), WIDTH)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shade_by_tables(surfaces, camera, light_to_world, root_rotation, tables, visible):  # type: ignore[no-untyped-def]
    """``SkyTables.shade`` of ``surfaces``: means, normals, albedo, roughness and visibility."""
    root_to_light = np.zeros((3, 3))
    for row in range(3):
        for column in range(3):
            for k in range(3):
                root_to_light[row, column] += light_to_world[k, row] * root_rotation[k, column]
    rotation = rotation_matrix(tables.directions, tables.weighted, root_to_light).astype(np.float32)
    rotations = light_to_world.astype(np.float32), root_to_light.astype(np.float32)
    radiance = np.zeros((len(visible), 3), np.float32)
    diffuse = rotated(tables.diffuse, rotation)
    shade_from_tables(surfaces, camera, rotations, (diffuse, tables.specular, tables.lobes), visible, radiance)
    return radiance


@cache
def octahedral_nodes(size: int) -> Floats32:
    """Unit directions [size², 3] of the nodes of a square grid folded into an octahedron.

    Nodes are on the square's edges too, so a bilinear look-up needs no border (Cigolle et al. 2014, "A Survey of
    Efficient Representations for Independent Unit Vectors").
    """
    line = np.linspace(-1, 1, size)
    b, a = np.meshgrid(line, line, indexing="ij")
    c = 1 - np.abs(a) - np.abs(b)
    fold = np.maximum(-c, 0)
    nodes = np.stack([a - np.copysign(fold, a), b - np.copysign(fold, b), c], axis=-1)
    return np.asarray((nodes / np.linalg.norm(nodes, axis=-1, keepdims=True)).reshape(-1, 3), np.float32)


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _sum_diffuse(nodes, directions, weighted, sums):  # type: ignore[no-untyped-def]
    """Σ_k weighted [K, 48] max(n·ω_k, 0) at every node; unlike a BLAS product the order of addition is fixed."""
    for i in numba.prange(len(nodes)):
        x, y, z = nodes[i, 0], nodes[i, 1], nodes[i, 2]
        first, second, third = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
        for k in range(len(directions)):
            cosine = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
            if cosine > 0:
                row = 3 * WIDTH * k
                first += cosine * load(weighted, row)
                second += cosine * load(weighted, row + WIDTH)
                third += cosine * load(weighted, row + 2 * WIDTH)
        store(sums, 3 * WIDTH * i, first)
        store(sums, 3 * WIDTH * i + WIDTH, second)
        store(sums, 3 * WIDTH * i + 2 * WIDTH, third)


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _prefilter(nodes, texels, widths, specular):  # type: ignore[no-untyped-def]
    """Mean radiance under 1/(1 + width − cos)²; ``texels`` [7, K]: direction, solid angle, flux; K a multiple of 16."""
    count = texels.shape[1]
    for i in numba.prange(len(nodes)):
        x, y, z = nodes[i, 0], nodes[i, 1], nodes[i, 2]
        for level in range(len(widths)):
            top = _ONE + widths[level]
            weights, red, green, blue = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
            for k in range(0, count, WIDTH):
                cosine = x * load(texels, k) + y * load(texels, count + k) + z * load(texels, 2 * count + k)
                weight = _ONE / ((top - cosine) * (top - cosine))
                weights += weight * load(texels, 3 * count + k)
                red += weight * load(texels, 4 * count + k)
                green += weight * load(texels, 5 * count + k)
                blue += weight * load(texels, 6 * count + k)
            total = reduce_add(weights)
            specular[level, i, 0] = reduce_add(red) / total
            specular[level, i, 1] = reduce_add(green) / total
            specular[level, i, 2] = reduce_add(blue) / total
