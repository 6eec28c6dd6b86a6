"""Shading as it is defined, in plain float64: what every faster way is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .brdf import brdf
from .gaussians import Gaussians
from .light import Light, texel_directions, texel_solid_angles
from .sh import sh_basis

Floats = NDArray[np.float64]

_AT_A_TIME = 2**19  # pairs of a Gaussian and a texel: some arrays of float64, 4 MB each


def shade_reference(
    gaussians: Gaussians, light: Light, camera_position: ArrayLike, *, texels: tuple[int, int] = (32, 64)
) -> Floats:
    """Linear radiance [N, 3] that each Gaussian sends to the camera, summed over every texel of the light.

        L_o = max(0, Σ_k L_k Δω_k v(ω_k) f(ω_k, ω_o) max(n·ω_k, 0)),   v(ω) = Σ_j v_j Y_j(ω)

    over the light downsized to ``texels`` (height, width). v is linear: it is **not** clamped to [0, 1], since
    that costs 5 dB under an overcast sky; only the sum is clamped, at 0.

    Args:
        camera_position: [3] m, world.
    """
    probe = light.resized(*texels)
    local = texel_directions(*texels).reshape(-1, 3)
    directions = local @ light.rotation.T  # world
    flux = (probe.radiance.astype(np.float64) * texel_solid_angles(*texels)[..., None]).reshape(-1, 3)
    basis = sh_basis(
        directions @ np.asarray(gaussians.root_rotation, np.float64)
    )  # rows times R: root's frame
    to_camera = np.asarray(camera_position, np.float64) - gaussians.means
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    radiance = np.empty((len(gaussians.means), 3))
    chunk = max(1, _AT_A_TIME // len(directions))
    for start in range(0, len(radiance), chunk):
        part = slice(start, start + chunk)
        normals = np.asarray(gaussians.normals[part], np.float64)
        n_dot_l, l_dot_v = normals @ directions.T, to_camera[part] @ directions.T  # [chunk, K]
        n_dot_v = np.sum(normals * to_camera[part], axis=-1, keepdims=True)
        visibility = np.asarray(gaussians.visibility[part], np.float64) @ basis.T
        roughness = np.asarray(gaussians.roughness[part], np.float64)[:, None]
        arriving = visibility * np.maximum(n_dot_l, 0)
        for channel in range(3):
            albedo = np.asarray(gaussians.albedo[part, channel], np.float64)[:, None]
            reflectance = brdf(albedo, roughness, n_dot_l, n_dot_v, l_dot_v)
            radiance[part, channel] = (arriving * reflectance) @ flux[:, channel]
    return np.maximum(radiance, 0)
