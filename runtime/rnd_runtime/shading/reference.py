"""Float64 reference of shading."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.sh import sh_basis

from .brdf import specular, specular_share
from .direct import AT_SILHOUETTE, TURNED_AWAY
from .directional import extract_directional
from .light import Light, texel_directions, texel_solid_angles
from .shader import SHADOW_RESOLUTION, shadow_radii
from .shadow import directional_visibility

Floats = NDArray[np.float64]

_AT_A_TIME = 2**14  # pairs of Gaussian and texel: arrays of 128 kB


def shade_reference(
    gaussians: Gaussians, light: Light, camera_position: ArrayLike, *, texels: tuple[int, int] = (32, 64)
) -> Floats:
    """Linear radiance [N, 3] of each Gaussian towards the camera, summed over every texel of the light.

        L_o = max(0, Σ_k L_k Δω_k v(ω_k) f(ω_k, ω_o) max(n·ω_k, 0)),   v(ω) = Σ_j v_j Y_j(ω)

    v is **not** clamped to [0, 1], which would cost 5 dB under an overcast sky; only the sum is clamped, at 0.

    Args:
        camera_position: [3] m, world.
        texels: (height, width) the light is downsized to.
    """
    probe = light.resized(*texels)
    directions = texel_directions(*texels).reshape(-1, 3) @ light.rotation.T  # world
    flux = (probe.radiance.astype(np.float64) * texel_solid_angles(*texels)[..., None]).reshape(-1, 3)
    # rows times R: root frame
    basis = sh_basis(directions @ np.asarray(gaussians.root_rotation, np.float64))
    coefficients = np.asarray(gaussians.visibility, np.float64)
    summed = _sum_over_texels(gaussians, directions, flux, lambda part: coefficients[part] @ basis.T, camera_position)
    return np.maximum(summed, 0)


def shade_reference_with_directional(
    gaussians: Gaussians, light: Light, camera_position: ArrayLike, *, texels: tuple[int, int] = (32, 64)
) -> Floats:
    """Reference of ``table+sun``: the sky as in ``shade_reference``, and every texel of the directional lights.

        L_o = sky + Σ_s V_s Σ_{k in s} ΔL_k Δω_k f(ω_k, ω_o) max(n·ω_k, 0)

    ΔL is what ``directional.extract_directional`` removes for the nearest light s, V_s the visibility of its centre by
    ``Shader``'s depth maps. Arguments as for ``shade_reference``.
    """
    sky, lights = extract_directional(light)
    radiance = shade_reference(gaussians, sky, camera_position, texels=texels)
    if not lights:
        return radiance
    height, width = sky.radiance.shape[:2]
    full = light.resized(height, width).radiance.astype(np.float64) - sky.radiance
    taken = np.abs(full).max(axis=-1) > 0
    local = texel_directions(height, width)[taken]
    flux = full[taken] * np.broadcast_to(texel_solid_angles(height, width), taken.shape)[taken][:, None]
    middles = np.array([k.direction for k in lights])
    nearest = np.argmax(local @ middles.T, axis=1)
    reached = _reached_by_lights(gaussians, middles @ light.rotation.T, camera_position)
    for k in range(len(lights)):
        own = nearest == k
        visibility = reached[:, k : k + 1].__getitem__
        directions = local[own] @ light.rotation.T
        radiance += _sum_over_texels(gaussians, directions, flux[own], visibility, camera_position)
    return radiance


def _reached_by_lights(gaussians: Gaussians, directions: Floats, camera_position: ArrayLike) -> Floats:
    """Visibility [N, S] of directional lights in world ``directions`` [S, 3], with the shader's fade."""
    shadows = directional_visibility(
        gaussians.means, gaussians.normals, directions, radii=shadow_radii(gaussians), resolution=SHADOW_RESOLUTION
    )
    n_dot_v = np.sum(np.asarray(gaussians.normals, np.float64) * _to_camera(gaussians, camera_position), axis=-1)
    fades = np.clip((n_dot_v - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), 0, 1)
    return np.asarray(shadows * fades[:, None], np.float64)


def _to_camera(gaussians: Gaussians, camera_position: ArrayLike) -> Floats:
    towards = np.asarray(camera_position, np.float64) - gaussians.means
    return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def _sum_over_texels(
    gaussians: Gaussians,
    directions: Floats,
    flux: Floats,
    visibility: Callable[[slice], Floats],
    camera_position: ArrayLike,
) -> Floats:
    """Σ_k flux_k v f max(n·ω_k, 0) [N, 3] of texels with world ``directions`` [K, 3] and L Δω ``flux`` [K, 3].

    ``visibility`` maps a slice of n Gaussians to [n, K] or [n, 1].
    """
    to_camera = _to_camera(gaussians, camera_position)
    radiance = np.empty((len(gaussians.means), 3))
    chunk = max(1, _AT_A_TIME // len(directions))
    for start in range(0, len(radiance), chunk):
        part = slice(start, start + chunk)
        normals = np.asarray(gaussians.normals[part], np.float64)
        n_dot_l, l_dot_v = normals @ directions.T, to_camera[part] @ directions.T  # [chunk, K]
        n_dot_v = np.sum(normals * to_camera[part], axis=-1, keepdims=True)
        roughness = np.asarray(gaussians.roughness[part], np.float64)[:, None]
        visible_cosine = visibility(part) * np.maximum(n_dot_l, 0)
        # f = albedo/π + specular, which all channels share
        share = specular_share(*np.asarray(gaussians.albedo[part], np.float64).T)[:, None]
        specular_sum = share * visible_cosine * specular(roughness, n_dot_l, n_dot_v, l_dot_v)
        radiance[part] = gaussians.albedo[part] / np.pi * (visible_cosine @ flux) + specular_sum @ flux
    return radiance
