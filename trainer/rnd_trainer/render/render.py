"""Differentiable image of a training step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rnd_runtime.core.camera import Camera
from rnd_trainer.model.model import AvatarModel, PosedGaussians, PoseInput

from .probe import Texels
from .raster import rasterize
from .shading import light_visibility, shade, traced_visibility, view_visibility, visible_towards


@dataclass
class Splat:
    """Differentiable image, premultiplied by ``alpha``."""

    image: Tensor  # [H, W, 3] linear
    normals: Tensor  # [H, W, 3] camera axes
    alpha: Tensor  # [H, W]
    albedo: Tensor | None = None  # [H, W, 3] linear, where asked for


def splat(
    posed: PosedGaussians, radiance: Tensor, camera: Camera, *, albedo: bool = False, cull: float = -1.0
) -> Splat:
    """Rasterise ``radiance`` [N, 3], the normals and on demand the albedo of posed Gaussians in one pass.

    Gaussians whose cosine n·v of normal and view is below ``cull`` are left out.
    """
    rotation = torch.as_tensor(camera.world_to_camera[:3, :3], dtype=torch.float32, device=radiance.device)
    static, opacity = posed.attributes, posed.attributes.opacity
    if cull > -1:
        front, _ = visible_towards(posed.normals, posed.means, camera, cull)
        opacity = torch.zeros_like(opacity).index_copy(0, front, opacity[front])
    features = torch.cat([radiance, posed.normals @ rotation.T, *([static.albedo] if albedo else [])], dim=-1)
    image, alpha, _ = rasterize(posed.means, posed.covariances, opacity, features, camera)
    return Splat(image[..., :3], image[..., 3:6], alpha, image[..., 6:] if albedo else None)


def shade_visible(
    posed: PosedGaussians, pose: PoseInput, texels: Texels, camera: Camera, model: AvatarModel, traced_texels: int
) -> Tensor:
    """Radiance [N, 3] of the Gaussians facing the camera, zero for the others.

    The first ``traced_texels`` directions have traced shadows. Images do not train the visibility, except with
    ``visibility="paper"``, where it is one factor per Gaussian, of the direction to the camera.
    """
    front, view = visible_towards(posed.normals, posed.means, camera)
    static, root = posed.attributes, pose.bones[0, :, :3].detach()
    kind = model.config.visibility
    if kind == "pose":
        traced = None
        if traced_texels:
            brightest = texels.directions[:traced_texels]
            traced = traced_visibility(posed.means, posed.normals, brightest, float(model.spacing))[front]
        with torch.no_grad():
            visibility = light_visibility(posed.visibility[front], texels.directions, root, traced)
    else:
        visibility = view.new_ones(len(front), len(texels.directions))
    shaded = shade(posed.normals[front], view, static.albedo[front], static.roughness[front], visibility, texels)
    if kind == "paper":
        shaded = shaded * view_visibility(posed.visibility[front], view, root)
    return torch.zeros_like(posed.means).index_copy(0, front, shaded)
