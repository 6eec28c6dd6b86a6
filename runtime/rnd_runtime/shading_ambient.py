"""The cheapest shading: a light of sixteen harmonics and one number of occlusion per Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._raster_input import floats, mask
from .gaussians import Gaussians
from .light import Light, texel_directions, texel_solid_angles
from .sh import sh_basis, sh_columns, sh_rotation
from .shading_lookup import ROUGHNESS_LOW, ROUGHNESS_SPAN, transposed
from .specular_lobe import lobe_table

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_TINY = np.float32(1e-12)
# max(cos, 0)/π leaves of degree 0 to 2 (Ramamoorthi, Hanrahan 2001); of degree 3 it leaves nothing
_COSINE = np.array([1, 2 / 3, 1 / 4], np.float32)


@dataclass(frozen=True, eq=False)
class AmbientLight:
    """A light probe as spherical harmonics of degree 3.

    Attributes:
        coefficients: [16, 3] linear radiance, in the light probe's frame.
    """

    coefficients: Floats

    @classmethod
    def project(cls, light: Light, texels: tuple[int, int]) -> AmbientLight:
        """From ``light`` downsized to ``texels`` (height, width)."""
        flux = light.resized(*texels).radiance * texel_solid_angles(*texels)[..., None]
        return cls(np.einsum("hwj,hwc->jc", sh_basis(texel_directions(*texels)), flux))

    def shade(
        self,
        gaussians: Gaussians,
        camera_position: ArrayLike,
        light_to_world: Floats,
        seen: ArrayLike | None = None,
    ) -> Floats32:
        """Linear radiance [N, 3] towards the camera: (albedo · E(n)/π + specular of the bare light) · occlusion.

        Occlusion is the visibility's mean over the upper hemisphere, weighted by the cosine. Both it and E(n)
        are exact up to degree 2 and know nothing of each other: light from the open side counts no more than
        from the blocked one. 0 where not ``seen``.
        """
        root = np.asarray(gaussians.root_rotation, np.float64)
        in_root = sh_rotation(root.T @ light_to_world) @ self.coefficients
        radiance = np.zeros((len(gaussians.means), 3), np.float32)
        _ambient(
            floats(gaussians.means),
            floats(gaussians.normals),
            floats(gaussians.albedo),
            floats(gaussians.roughness),
            floats(gaussians.visibility),
            np.array(camera_position, np.float32),
            np.array(root, np.float32, order="C"),
            (np.array(in_root, np.float32, order="C"), lobe_table()),
            mask(seen, len(radiance)),
            radiance,
        )
        return radiance


_sh_columns = numba.njit(sh_columns)


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _ambient(  # type: ignore[no-untyped-def]
    means, normals, albedo, roughness, visibility, camera, root_rotation, tables, seen, radiance
):
    light, lobes = tables
    for i in numba.prange(len(means)):
        if not seen[i]:
            continue
        nx, ny, nz = transposed(root_rotation, normals[i, 0], normals[i, 1], normals[i, 2])
        vx, vy, vz = camera[0] - means[i, 0], camera[1] - means[i, 1], camera[2] - means[i, 2]
        vx, vy, vz = transposed(root_rotation, vx, vy, vz)
        distance = max(np.sqrt(vx * vx + vy * vy + vz * vz), _TINY)
        vx, vy, vz = vx / distance, vy / distance, vz / distance
        n_dot_v = nx * vx + ny * vy + nz * vz
        energy, mx, my, mz, _, shrink1, shrink2, shrink3 = _lobe_at(
            lobes, roughness[i], n_dot_v, nx, ny, nz, vx, vy, vz
        )
        at_normal, at_lobe = _sh_columns(nx, ny, nz), _sh_columns(mx, my, mz)
        occlusion, diffuse_r, diffuse_g, diffuse_b = _ZERO, _ZERO, _ZERO, _ZERO
        shine_r, shine_g, shine_b = _ZERO, _ZERO, _ZERO
        for j in range(16):
            shrink = np.float32(1) if j < 1 else (shrink1 if j < 4 else (shrink2 if j < 9 else shrink3))
            weight = shrink * np.float32(at_lobe[j])
            shine_r += weight * light[j, 0]
            shine_g += weight * light[j, 1]
            shine_b += weight * light[j, 2]
            if j < 9:
                weight = _COSINE[0 if j < 1 else (1 if j < 4 else 2)] * np.float32(at_normal[j])
                occlusion += weight * visibility[i, j]
                diffuse_r += weight * light[j, 0]
                diffuse_g += weight * light[j, 1]
                diffuse_b += weight * light[j, 2]
        occlusion = max(occlusion, _ZERO)
        radiance[i, 0] = occlusion * (albedo[i, 0] * max(diffuse_r, _ZERO) + energy * max(shine_r, _ZERO))
        radiance[i, 1] = occlusion * (albedo[i, 1] * max(diffuse_g, _ZERO) + energy * max(shine_g, _ZERO))
        radiance[i, 2] = occlusion * (albedo[i, 2] * max(diffuse_b, _ZERO) + energy * max(shine_b, _ZERO))


@numba.njit(cache=True, error_model="numpy")
def _lobe_at(lobes, roughness, n_dot_v, nx, ny, nz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """``lobe_table`` between its nodes: energy, mean direction (x, y, z), place among the widths, attenuations."""
    rows, columns = lobes.shape[0] - 1, lobes.shape[1] - 1
    a = min(max((roughness - ROUGHNESS_LOW) / ROUGHNESS_SPAN, _ZERO), _ONE) * np.float32(rows)
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
