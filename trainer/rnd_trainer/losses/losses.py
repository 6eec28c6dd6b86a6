"""Loss terms, each a scalar; weights are in ``config``."""

from __future__ import annotations

import torch
from torch import Tensor

from rnd_trainer.model.model import PosedGaussians
from rnd_trainer.render.probe import luminance, natural_sky

from .metrics import SSIM_WINDOW, mean_ssim

ALLOWED_STRETCH = 1.7
"""stretch (ratio of lengths) without a penalty"""
ALBEDO_BLOCKS = 16
"""blocks along an image's longer side over which albedos are compared, as estimates are blurred"""
MIN_ALBEDO = 0.004
"""linear; below, eight bits of sRGB make steps of more than 8 %"""


def image_loss(image_srgb: Tensor, target_srgb: Tensor, weight_dssim: float, scales: int = 1) -> Tensor:
    """L1 plus weighted 1 − SSIM of two sRGB images [H, W, 3], averaged over ``scales`` halvings of both."""
    l1 = (image_srgb - target_srgb).abs().mean()
    if weight_dssim == 0:
        return l1
    return l1 + weight_dssim * multiscale_dssim(image_srgb, target_srgb, scales)


def multiscale_dssim(image_srgb: Tensor, target_srgb: Tensor, scales: int) -> Tensor:
    """Mean of 1 − SSIM over ``scales`` halvings, while the 11-pixel window fits."""
    terms = []
    for scale in range(scales):
        if scale:
            image_srgb, target_srgb = _block_means(image_srgb, 2), _block_means(target_srgb, 2)
            if min(image_srgb.shape[:2]) < SSIM_WINDOW:
                break
        terms.append(1 - mean_ssim(image_srgb, target_srgb))
    return torch.stack(terms).mean()


def albedo_loss(albedo: Tensor, estimate: Tensor, known: Tensor) -> Tensor:
    """L1 of the log ratio of two linear albedos [H, W, 3], less its median per channel, which is not differentiated.

    An estimate is right up to brightness and tint. The median takes both out, and as many ratios lie above it as below:
    the term leaves the albedo's level alone. Details are the image's: both are averaged over blocks, by their pixels
    that are ``known`` [H, W]; blocks of which less than half is known do not count.
    """
    side = max(1, max(known.shape) // ALBEDO_BLOCKS)
    share = _block_means(known[..., None].float(), side)
    counted = share[..., 0] >= 0.5
    if not counted.any():
        return albedo.new_zeros(())
    first, second = (
        _block_means(torch.where(known[..., None], x, 0), side)[counted].clamp(min=MIN_ALBEDO).log()
        for x in (albedo, estimate)
    )
    ratio = first - second
    return (ratio - ratio.detach().median(dim=0).values).abs().mean()


def _block_means(image: Tensor, side: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), side).permute(1, 2, 0)


def skinning_divergence(weights: Tensor, log_template: Tensor) -> Tensor:
    """KL(W ‖ W_template) [N, J] averaged over the Gaussians."""
    return (weights * (weights.clamp(min=1e-12).log() - log_template)).sum(-1).mean()


def stretch_penalty(stretch: Tensor) -> Tensor:
    """Mean of max(0, stretch − ``ALLOWED_STRETCH``)² over edges [E]; 0 without edges (after Kilian et al. 2007)."""
    return torch.relu(stretch - ALLOWED_STRETCH).square().sum() / max(len(stretch), 1)


def geometry_prior(posed: PosedGaussians, weight_offset: float, weight_residual: float) -> Tensor:
    """Mean squares of the pose offset (in units of its bound) and of the geometric residuals."""
    residual = posed.attributes.raw_geometry_residual
    return weight_offset * posed.offset.square().mean() + weight_residual * residual.square().mean()


def chroma_prior(radiance: Tensor, start: Tensor, solid_angles: Tensor) -> Tensor:
    """Mean absolute log r/g and log b/g of a probe [32, 64, 3] relative to those of ``start``.

    Fixes the colour that light and albedo share, in every direction. Half of the weight goes by solid angle, half by
    the power of ``start``: a sun is small and decides most.
    """
    power = luminance(start) * solid_angles
    weight = solid_angles / solid_angles.sum() + power / power.sum()
    log_ratio = torch.log(radiance / start)
    chroma = (log_ratio[..., [0, 2]] - log_ratio[..., 1:2]).abs().mean(-1)
    return 0.5 * (chroma * weight).sum()


def sky_prior(radiance: Tensor, directions: Tensor, solid_angles: Tensor) -> Tensor:
    """Mean of d² / (1 + d²) (Geman and McClure), d the log ratio of a probe [32, 64, 3] and a natural sky."""
    log_ratio = torch.log(luminance(radiance)) - torch.log(natural_sky(directions[..., 1]))
    square = (log_ratio - log_ratio.detach().median()).square()
    return (square / (1 + square) * solid_angles).sum() / solid_angles.sum()


def linear_to_srgb(linear: Tensor) -> Tensor:
    """sRGB transfer function; above 1 the slope is 0.01, so that clipped highlights have a gradient."""
    x = linear.clamp(min=0)
    x = torch.where(x > 1, 1 + 0.01 * (x - 1), x)
    low = 12.92 * x
    high = 1.055 * x.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(x <= 0.0031308, low, high)
