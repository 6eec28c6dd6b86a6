"""Physically based shading of visible Gaussians under sampled texels."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.core.camera import Camera
from rnd_runtime.shading.brdf import specular, specular_share
from rnd_runtime.shading.sh import sh_columns
from rnd_runtime.shading.shadow import directional_visibility

from .probe import Texels
from .shading_kernel import FusedShade

BACK_FACING = -0.2
"""cosine n·v between normal and view below which a Gaussian is not shaded"""
SHADOW_RADIUS = 1.2
"""radius of a Gaussian in a shadow map, in units of the spacing"""


def sh_basis(directions: Tensor) -> Tensor:
    """SH basis [..., 16] of unit directions [..., 3]."""
    return torch.stack(sh_columns(*directions.unbind(-1)), dim=-1)


def visible_towards(
    normals: Tensor, means: Tensor, camera: Camera, least: float = BACK_FACING
) -> tuple[Tensor, Tensor]:
    """Indices of the Gaussians with n·v > ``least``, and unit directions [n, 3] towards the camera."""
    eye = torch.as_tensor(camera.position, dtype=means.dtype, device=means.device)
    view = torch.nn.functional.normalize(eye - means.detach(), dim=-1)
    front = ((normals.detach() * view).sum(-1) > least).nonzero()[:, 0]
    return front, view[front]


def light_visibility(
    coefficients: Tensor, texels: Tensor, root_rotation: Tensor, traced: Tensor | None = None
) -> Tensor:
    """v(x, ω) [n, K] at texel directions [K, 3] from root-frame SH coefficients [n, 16].

    ``traced`` [n, T] replaces the first T columns: SH of degree 3 do not resolve hard shadows.
    """
    visibility = coefficients @ sh_basis(texels @ root_rotation).T
    if traced is not None:
        visibility = torch.cat([traced, visibility[:, traced.shape[1] :]], dim=1)
    return visibility


def view_visibility(coefficients: Tensor, view: Tensor, root_rotation: Tensor) -> Tensor:
    """The paper's visibility [n, 1] ≥ 0: root-frame SH coefficients [n, 16] at the directions [n, 3] to the camera."""
    return (coefficients * sh_basis(view @ root_rotation)).sum(-1, keepdim=True).clamp(min=0)


def shade(
    normals: Tensor, view: Tensor, albedo: Tensor, roughness: Tensor, visibility: Tensor, texels: Texels
) -> Tensor:
    """Outgoing linear radiance [n, 3]: Σ_k v_k f(ω_k, ω_o) max(n·ω_k, 0) power_k (paper, eq. 3 and 4).

    normals, view [n, 3] unit; albedo [n, 3]; roughness [n]; visibility [n, K]. Float32 on the CPU uses the compiled
    kernel, without gradient by view and visibility.
    """
    if not normals.is_cuda and normals.dtype == torch.float32:
        return FusedShade.apply(normals, view, albedo, roughness, visibility, texels.directions, texels.power)
    n_dot_l = normals @ texels.directions.T  # [n, K]
    visible_cosine = visibility * n_dot_l.clamp(min=0)
    n_dot_v = (normals * view).sum(-1, keepdim=True)
    glossy = specular(roughness[:, None], n_dot_l, n_dot_v, view @ texels.directions.T)
    glossy = specular_share(*albedo.split(1, dim=-1)) * glossy
    radiance = albedo * (visible_cosine @ texels.power) / math.pi + (visible_cosine * glossy) @ texels.power
    return radiance.clamp(min=0)


def traced_visibility(means: Tensor, normals: Tensor, directions: Tensor, spacing: float) -> Tensor:
    """Shadow-mapped visibility [n, K] of points towards ``directions`` [K, 3]; no gradient."""
    arrays = [np.ascontiguousarray(t.detach().cpu().numpy()) for t in (means, normals, directions)]
    radii = np.full(len(means), SHADOW_RADIUS * spacing, np.float32)
    return torch.from_numpy(directional_visibility(*arrays, radii=radii)).to(means)
