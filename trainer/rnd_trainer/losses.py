"""Loss terms, each a scalar; their weights live in :mod:`rnd_trainer.config`."""

from __future__ import annotations

import torch
from torch import Tensor

from .metrics import ssim_map
from .model import Posed


def image_loss(image_srgb: Tensor, target_srgb: Tensor, weight_dssim: float) -> Tensor:
    """L1 plus weighted 1 − SSIM of two sRGB images [H, W, 3]."""
    l1 = (image_srgb - target_srgb).abs().mean()
    if weight_dssim == 0:
        return l1
    return l1 + weight_dssim * (1 - ssim_map(image_srgb, target_srgb).mean())


def skinning_divergence(weights: Tensor, log_template: Tensor) -> Tensor:
    """KL(W ‖ W_template) [N, J] averaged over the Gaussians."""
    return (weights * (weights.clamp(min=1e-12).log() - log_template)).sum(-1).mean()


def geometry_prior(posed: Posed, weight_offset: float, weight_residual: float) -> Tensor:
    """Mean squares of the pose offset (in units of its bound) and of the geometric residuals."""
    residual = posed.attributes.raw_geometry_residual
    return weight_offset * posed.offset.square().mean() + weight_residual * residual.square().mean()


def grey_prior(radiance: Tensor, solid_angles: Tensor) -> Tensor:
    """Mean absolute chroma of a probe [32, 64, 3] relative to its mean level."""
    grey = radiance.mean(dim=-1, keepdim=True)
    share = solid_angles / solid_angles.sum()
    return ((radiance - grey).abs().mean(-1) * share).sum() / (grey[..., 0] * share).sum()


def linear_to_srgb(linear: Tensor) -> Tensor:
    """The runtime's transfer function with a gradient everywhere: values above 1 keep a hundredth of theirs.

    Pictures are clipped at 1; a highlight that is far too bright must still feel it.
    """
    x = linear.clamp(min=0)
    x = torch.where(x > 1, 1 + 0.01 * (x - 1), x)
    low = 12.92 * x
    high = 1.055 * x.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(x <= 0.0031308, low, high)
