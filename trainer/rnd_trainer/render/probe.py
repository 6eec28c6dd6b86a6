"""Learnable light probes, and the texels that a training step sums over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rnd_runtime.shading.light import REC709_LUMINANCE, texel_directions, texel_solid_angles

PROBE_SHAPE = (32, 64)
"""rows and columns of the probe (paper, section 3.2)"""
UNIFORM_SHARE = 0.2
"""uniform share of the sampling probability, so that dark texels can brighten"""


@dataclass
class Texels:
    """K samples of incident light."""

    directions: Tensor  # [K, 3] towards the light
    power: Tensor  # [K, 3] = L Δω / probability


class LightProbes(nn.Module):
    """L(ω) of each light: 32×64 texels of linear RGB, stored as logarithms.

    The one factor that albedo and all lights share is fixed by Σ exposure · luminance = level, summed over lights and
    texels; initially a mean of 1 over the sphere.
    """

    directions: Tensor
    solid_angles: Tensor
    exposure: Tensor
    level: Tensor
    start: Tensor

    def __init__(self, channels: int = 3, lights: int = 1) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.zeros(lights, *PROBE_SHAPE, channels))
        self.register_buffer("directions", torch.as_tensor(texel_directions(*PROBE_SHAPE), dtype=torch.float32))
        self.register_buffer("solid_angles", torch.as_tensor(texel_solid_angles(*PROBE_SHAPE), dtype=torch.float32))
        self.register_buffer("exposure", (self.solid_angles / (4 * math.pi * lights)).repeat(lights, 1, 1))
        self.register_buffer("level", torch.ones(()))
        self.register_buffer("start", torch.ones(lights, *PROBE_SHAPE, 3))

    def radiance(self) -> Tensor:
        """[lights, 32, 64, 3] linear."""
        light = torch.exp(self.raw).expand(-1, *PROBE_SHAPE, 3)
        return light / (luminance(light) * self.exposure).sum() * self.level

    @torch.no_grad()
    def start_from(self, radiance: Tensor, exposure: Tensor) -> None:
        """Start from ``radiance`` [lights, 32, 64, 3] > 0; fix its luminance under ``exposure`` [lights, 32, 64]."""
        grey = self.raw.shape[-1] == 1
        self.start.copy_(radiance)
        self.raw.copy_(torch.log(luminance(radiance)[..., None] if grey else radiance))
        self.exposure.copy_(exposure)
        self.level.copy_((luminance(radiance) * exposure).sum())


def natural_sky(height: Tensor | NDArray[np.float64]) -> Any:
    """Prior relative radiance of a direction with ``height`` y in −1…1.

    The ground reflects a fifth to a third of what falls on it: the halves of the sphere differ two- to threefold.
    """
    return 1 + 0.9 * height


def luminance(rgb: Tensor) -> Tensor:
    """Rec.709 luminance of linear RGB [..., 3]."""
    return rgb @ rgb.new_tensor(REC709_LUMINANCE)


def all_texels(radiance: Tensor, directions: Tensor, solid_angles: Tensor) -> Texels:
    """All texels, brightest first."""
    power = (radiance * solid_angles[..., None]).reshape(-1, 3)
    order = torch.argsort(luminance(power.detach()), descending=True, stable=True)
    return Texels(directions.reshape(-1, 3)[order], power[order])


def sample_texels(
    radiance: Tensor, directions: Tensor, solid_angles: Tensor, count: int, generator: torch.Generator
) -> Texels:
    """About ``count`` texels by systematic sampling with inclusion probability min(1, c · importance).

    Texels whose share exceeds 1/count are always included; the others are weighted by the inverse of their probability
    (Horvitz & Thompson 1952). Brightest first.
    """
    importance = (luminance(radiance.detach()) * solid_angles).flatten()
    importance = (1 - UNIFORM_SHARE) * importance / importance.sum() + UNIFORM_SHARE * solid_angles.flatten() / (
        4 * math.pi
    )
    inclusion = importance * count
    for _ in range(4):  # redistribute the excess over 1
        always = inclusion >= 1
        rest = importance * (count - int(always.sum())) / importance[~always].sum()
        inclusion = torch.where(always, 1.0, rest)
    offset = torch.rand((), generator=generator).to(inclusion)
    ticks = torch.floor(torch.cumsum(inclusion.clamp(max=1).double(), 0) + offset.double())
    sampled = torch.diff(ticks, prepend=ticks.new_zeros(1)) > 0
    sampled = (sampled | (inclusion >= 1)).nonzero()[:, 0]
    sampled = sampled[torch.argsort(importance[sampled], descending=True, stable=True)]
    power = (radiance * solid_angles[..., None]).reshape(-1, 3)[sampled] / inclusion[sampled].clamp(max=1)[:, None]
    return Texels(directions.reshape(-1, 3)[sampled], power)


def as_probe(radiance: np.ndarray) -> Tensor:
    """Light map [32, 64, 3] as a tensor."""
    return torch.as_tensor(np.ascontiguousarray(radiance), dtype=torch.float32)
