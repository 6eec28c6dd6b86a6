"""L_gc: consistency of perceptual features between the training view and a virtual one (paper, eq. 12).

InfoNCE (van den Oord et al. 2018) between features of points that both views see. The formula as printed counts the
positive twice and has no temperature; this is the usual cross entropy.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rnd_runtime.core.camera import Camera
from rnd_trainer.model.model import PosedGaussians
from rnd_trainer.render.in_sight import in_sight

from .perceptual import Perceptual

YAW, PITCH = math.radians(25), math.radians(8)
"""largest angles between virtual and training camera, seen from the body"""
GRAZING = math.sin(math.radians(9))
"""smallest cosine between normal and view of a visible point (the paper's t = 9°)"""
OCCLUSION = 0.02
"""distance behind the first surface up to which a point is visible, m"""
TEMPERATURE = 0.07
"""of InfoNCE, on unit features (He et al. 2020)"""
POINTS = 192
"""points sampled among those that both cameras see"""
LAYERS = 3
"""first layers of the network; deeper cells are as wide as a limb"""


def virtual_camera(camera: Camera, centre: Tensor, generator: torch.Generator) -> Camera:
    """``camera`` rotated around ``centre`` [3] m by random yaw and pitch within ``YAW`` and ``PITCH``."""
    yaw, pitch = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1).tolist()
    yaw, pitch = YAW * yaw, PITCH * pitch
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    orbit = about_x @ about_y  # camera axes
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    middle = rotation @ centre.double().cpu().numpy() + translation
    virtual = np.eye(4)
    virtual[:3, :3] = orbit @ rotation
    virtual[:3, 3] = orbit @ (translation - middle) + middle
    return dataclasses.replace(camera, world_to_camera=virtual)


def covisible(posed: PosedGaussians, first: Camera, second: Camera, count: int) -> Tensor:
    """Indices of those among the first ``count`` Gaussians that both cameras see."""
    seen = [in_sight(posed, camera, count, facing=GRAZING, occlusion=OCCLUSION).visible for camera in (first, second)]
    return torch.from_numpy(np.flatnonzero(seen[0] & seen[1])).to(posed.means.device)


def consistency_loss(
    first_srgb: Tensor, second_srgb: Tensor, first_pixels: Tensor, second_pixels: Tensor, perceptual: Perceptual
) -> Tensor:
    """InfoNCE between features at matched pixels of two images, mean over points and layers.

    Args:
        first_srgb, second_srgb: [H, W, 3] in 0…1.
        first_pixels, second_pixels: [P, 2] x, y of the same P points, pixel centres at +0.5.
    """
    matches = torch.arange(len(first_pixels), device=first_pixels.device)
    losses = []
    shallow = dataclasses.replace(perceptual, layers=min(LAYERS, perceptual.layers))
    for a, b, grid in zip(shallow.features(first_srgb), shallow.features(second_srgb), shallow.grids):
        unit_a, unit_b = _look_up(a, first_pixels, grid), _look_up(b, second_pixels, grid)
        losses.append(functional.cross_entropy(unit_a @ unit_b.T / TEMPERATURE, matches))
    return torch.stack(losses).mean()


def project(points: Tensor, camera: Camera) -> Tensor:
    """Pixels [P, 2] of points [P, 3] m, pixel centres at +0.5."""
    rotation, translation, K = (
        torch.as_tensor(x, dtype=points.dtype, device=points.device)
        for x in (camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3], camera.K)
    )
    homogeneous = (points @ rotation.T + translation) @ K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def _look_up(features: Tensor, pixels: Tensor, grid: tuple[int, float]) -> Tensor:
    """Unit features [P, C] of a map [C, h, w] at pixels [P, 2], bilinear, clamped at its borders."""
    stride, offset = grid
    cells = (pixels - offset) / stride
    size = cells.new_tensor([features.shape[2] - 1, features.shape[1] - 1]).clamp(min=1)
    sample = functional.grid_sample(
        features[None], (2 * cells / size - 1)[None, None], align_corners=True, padding_mode="border"
    )
    return functional.normalize(sample[0, :, 0].T, dim=-1)
