"""A ball of posed Gaussians, and a camera in front of it."""

from __future__ import annotations

import torch

from rnd_runtime.core.camera import Camera
from rnd_trainer.model.model import Attributes, PosedGaussians

RADIUS = 0.2  # m


def splat_ball(count: int = 4000, radius: float = RADIUS) -> PosedGaussians:
    """Opaque splats around the origin."""
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    size = (0.008**2) * torch.tensor([1.0, 0, 0, 1.0, 0, 1.0])
    one = torch.ones(count)
    static = Attributes(0.99 * one, *(normals,) * 6, one, normals)
    return PosedGaussians(radius * normals, size.expand(count, 6).contiguous(), normals, one, one, one, static)


def front_camera() -> Camera:
    """1.5 m away, 160 × 160."""
    return Camera.look_at([0, 0.1, 1.5], [0, 0, 0], width=160, height=160, fov_y=0.4)
