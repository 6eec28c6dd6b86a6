"""The learnable light probe and the texels a training step sums over."""

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
"""of the drawing probability: dark texels must be drawn too, or they could never brighten"""


@dataclass
class Texels:
    """K directions of incident light: directions [K, 3] towards the light, power [K, 3] = L Δω / probability."""

    directions: Tensor
    power: Tensor


class LightProbe(nn.Module):
    """L(ω): 32×64 texels of linear RGB, kept as logarithms, the luminance that reaches the body fixed.

    A logarithm lets a sun grow (its texel is a thousand times the sky's), which softplus does not in any
    number of steps that we would wait for. Albedo and light are known up to a common factor only; what is
    fixed chooses it: Σ exposure · luminance = level. Until ``start_from`` knows more, that is a mean of 1
    over the sphere.
    """

    directions: Tensor
    solid_angles: Tensor
    exposure: Tensor
    level: Tensor

    def __init__(self, channels: int = 3) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.zeros(*PROBE_SHAPE, channels))
        self.register_buffer("directions", torch.as_tensor(texel_directions(*PROBE_SHAPE), dtype=torch.float32))
        self.register_buffer("solid_angles", torch.as_tensor(texel_solid_angles(*PROBE_SHAPE), dtype=torch.float32))
        self.register_buffer("exposure", self.solid_angles / (4 * math.pi))
        self.register_buffer("level", torch.ones(()))

    def radiance(self) -> Tensor:
        """[32, 64, 3] linear."""
        light = torch.exp(self.raw).expand(*PROBE_SHAPE, 3)
        return light / (luminance(light) * self.exposure).sum() * self.level

    @torch.no_grad()
    def start_from(self, radiance: Tensor, exposure: Tensor) -> None:
        """Go on from ``radiance`` [32, 64, 3] > 0, whose luminance under ``exposure`` [32, 64] is kept from now on."""
        grey = self.raw.shape[-1] == 1
        self.raw.copy_(torch.log(luminance(radiance)[..., None] if grey else radiance))
        self.exposure.copy_(exposure)
        self.level.copy_((luminance(radiance) * exposure).sum())


def natural_sky(height: Tensor | NDArray[np.float64]) -> Any:
    """Relative radiance to expect from a direction of which pictures tell nothing, by its ``height`` y in −1…1.

    Light comes from above more than from below, five to three on average (after Dror et al. 2004).
    """
    return 1 + 0.5 * height


def luminance(rgb: Tensor) -> Tensor:
    """Rec.709 luminance of linear RGB [..., 3]."""
    return rgb @ rgb.new_tensor(REC709_LUMINANCE)


def all_texels(radiance: Tensor, directions: Tensor, solid_angles: Tensor) -> Texels:
    """Every texel once, the full sum. Brightest first."""
    power = (radiance * solid_angles[..., None]).reshape(-1, 3)
    order = torch.argsort(luminance(power.detach()), descending=True, stable=True)
    return Texels(directions.reshape(-1, 3)[order], power[order])


def sample_texels(
    radiance: Tensor, directions: Tensor, solid_angles: Tensor, count: int, generator: torch.Generator
) -> Texels:
    """About ``count`` texels by systematic sampling with inclusion probability min(1, c · importance).

    A texel whose share exceeds 1/count (a sun) is always in, with its exact power; the rest are unbiased by
    the inverse of their probability (Horvitz & Thompson 1952). Brightest first.
    """
    importance = (luminance(radiance.detach()) * solid_angles).flatten()
    importance = (1 - UNIFORM_SHARE) * importance / importance.sum() + UNIFORM_SHARE * solid_angles.flatten() / (
        4 * math.pi
    )
    inclusion = importance * count
    for _ in range(4):  # what exceeds 1 is handed to the rest
        sure = inclusion >= 1
        rest = importance * (count - int(sure.sum())) / importance[~sure].sum()
        inclusion = torch.where(sure, 1.0, rest)
    offset = torch.rand((), generator=generator).to(inclusion)
    ticks = torch.floor(torch.cumsum(inclusion.clamp(max=1).double(), 0) + offset.double())
    drawn = torch.diff(ticks, prepend=ticks.new_zeros(1)) > 0
    drawn = (drawn | (inclusion >= 1)).nonzero()[:, 0]
    drawn = drawn[torch.argsort(importance[drawn], descending=True, stable=True)]
    power = (radiance * solid_angles[..., None]).reshape(-1, 3)[drawn] / inclusion[drawn].clamp(max=1)[:, None]
    return Texels(directions.reshape(-1, 3)[drawn], power)


def as_probe(radiance: np.ndarray) -> Tensor:
    """A light map [32, 64, 3] as a tensor, for training under a known light."""
    return torch.as_tensor(np.ascontiguousarray(radiance), dtype=torch.float32)
