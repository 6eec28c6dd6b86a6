"""The cheapest shading: a light of sixteen SH coefficients times ambient occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, mask
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.simd.arithmetic import at_least, lanes
from rnd_runtime.core.simd.memory import aligned_floats, load, store
from rnd_runtime.core.simd.vectors import WIDTH
from rnd_runtime.shading.sh import COSINE_LOBE, compiled_sh_columns, sh_basis, sh_rotation

from .brdf import specular_share_lanes
from .lanes import (
    ALBEDO,
    CHUNK,
    FREE,
    NORMAL,
    RADIANCE,
    VIEW,
    ZERO,
    gather,
    load3,
    lobe_direction,
    lobes_in_lanes,
    nan_lanes,
    scatter,
    transposed,
    unit,
    visibility_in_lanes,
)
from .light import Light, texel_directions, texel_solid_angles
from .specular_lobe import lobe_rows

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class AmbientLight:
    """A light probe as spherical harmonics of degree 3.

    Attributes:
        coefficients: [16, 3] linear radiance, in the light probe's frame.
    """

    coefficients: Floats

    @classmethod
    def project(cls, light: Light, texels: tuple[int, int]) -> AmbientLight:
        """Project ``light``, downsized to ``texels`` (height, width)."""
        flux = light.resized(*texels).radiance * texel_solid_angles(*texels)[..., None]
        return cls(np.einsum("hwj,hwc->jc", sh_basis(texel_directions(*texels)), flux))

    def shade(
        self, gaussians: Gaussians, camera_position: ArrayLike, light_to_world: Floats, visible: ArrayLike | None = None
    ) -> Floats32:
        """Linear radiance [N, 3] towards the camera: (albedo · E(n)/π + unoccluded specular) · occlusion.

        Occlusion is the cosine-weighted mean visibility over the upper hemisphere. Occlusion and E(n) are exact up to
        degree 2 and independent of each other. 0 where not ``visible``.
        """
        root = np.asarray(gaussians.root_rotation, np.float64)
        in_root = sh_rotation(root.T @ light_to_world) @ self.coefficients
        radiance = np.zeros((len(gaussians.means), 3), np.float32)
        arrays = (gaussians.means, gaussians.normals, gaussians.albedo, gaussians.roughness, gaussians.visibility)
        _ambient(
            tuple(floats(array) for array in arrays),
            np.array(camera_position, np.float32),
            np.array(root, np.float32, order="C"),
            (np.array(in_root, np.float32, order="C"), lobe_rows()),
            mask(visible, len(radiance)),
            radiance,
        )
        return radiance


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _ambient(surfaces, camera, root_rotation, tables, visible, radiance):  # type: ignore[no-untyped-def]
    """``.lookup.shade_from_tables`` with ``tables``: the light [16, 3] in the root's frame, and the lobes."""
    for chunk in prange((len(visible) + CHUNK - 1) // CHUNK):
        indices, scratch = np.empty(WIDTH, np.int64), aligned_floats(FREE)
        rows, columns = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        i, last = chunk * CHUNK, min((chunk + 1) * CHUNK, len(visible))
        while i < last:
            i, count = gather(i, last, visible, surfaces, camera, indices, scratch)
            if count > 0:
                _shade_sixteen(indices, surfaces[4], root_rotation, tables, scratch, rows, columns)
                scatter(count, indices, scratch, radiance)


@njit(error_model="numpy")
def _shade_sixteen(indices, visibility, root_rotation, tables, scratch, rows, columns):  # type: ignore[no-untyped-def]
    """Radiance, written over the albedo in ``scratch``; ``rows`` and ``columns`` [16, 16] are scratch."""
    light, lobes = tables
    normal = transposed(root_rotation, load3(scratch, NORMAL))
    view = unit(transposed(root_rotation, load3(scratch, VIEW)))
    n_dot_v = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    lobes_in_lanes(lobes, n_dot_v, scratch, rows, columns)
    energy, shrink = load(columns, 0), load3(columns, 4 * WIDTH)
    at_lobe = compiled_sh_columns(*lobe_direction(columns, normal, view, n_dot_v))
    at_normal = compiled_sh_columns(*normal)
    visibility_in_lanes(indices, visibility, rows, columns)
    broken = nan_lanes(scratch, columns)

    energy = energy * specular_share_lanes(*load3(scratch, ALBEDO))
    occlusion = lanes(ZERO)
    for j in range(9):
        occlusion += COSINE_LOBE[j] * (at_normal[j] * load(columns, j * WIDTH))
    occlusion = at_least(occlusion, ZERO)
    for channel in range(3):
        diffuse, specular = lanes(ZERO), at_lobe[0] * light[0, channel]
        for j in range(9):
            diffuse += COSINE_LOBE[j] * light[j, channel] * at_normal[j]
        for j in range(1, 16):
            factor = shrink[0] if j < 4 else (shrink[1] if j < 9 else shrink[2])
            specular += factor * (at_lobe[j] * light[j, channel])
        at = channel * WIDTH
        diffuse_part = load(scratch, ALBEDO + at) * at_least(diffuse, ZERO)
        store(scratch, RADIANCE + at, occlusion * (diffuse_part + energy * at_least(specular, ZERO)) + broken)
