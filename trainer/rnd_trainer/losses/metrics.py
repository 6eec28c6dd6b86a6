"""Metrics of images and normal maps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .ssim_kernel import MeanSsim

SSIM_SIGMA, SSIM_WINDOW, SSIM_C1, SSIM_C2 = 1.5, 11, 0.01**2, 0.03**2
"""of Wang et al. 2004, as scikit-image with gaussian_weights=True, use_sample_covariance=False"""


def psnr(image: Tensor, target: Tensor, where: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of values in 0…1, over the pixels ``where`` [H, W] if given."""
    error = (image - target).square()
    mean = float((error if where is None else error[where]).mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity [H', W', C] of [H, W, C] images in 0…1, valid region (Wang et al. 2004, eq. 13)."""
    _check_size(image)
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)  # [C, H, W]
    window = _window(x)
    stack = torch.cat([x, y, x * x, y * y, x * y])[:, None]
    filtered = torch.nn.functional.conv2d(stack, (window[:, None] * window)[None, None])[:, 0]
    mean_x, mean_y, xx, yy, xy = filtered.chunk(5)
    similarity = (2 * mean_x * mean_y + SSIM_C1) * (2 * (xy - mean_x * mean_y) + SSIM_C2)
    similarity = similarity / ((mean_x**2 + mean_y**2 + SSIM_C1) * ((xx - mean_x**2) + (yy - mean_y**2) + SSIM_C2))
    return similarity.permute(1, 2, 0)


def mean_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean of ``ssim_map``. Float32 on the CPU uses the compiled kernel, without gradient by ``target``."""
    if image.is_cuda or image.dtype != torch.float32:
        return ssim_map(image, target).mean()
    _check_size(image)
    return MeanSsim.apply(image, target, _window(image), SSIM_C1, SSIM_C2)


def ssim(image: Tensor, target: Tensor) -> float:
    """Mean of ``ssim_map``."""
    return float(mean_ssim(image, target))


def _check_size(image: Tensor) -> None:
    assert min(image.shape[:2]) >= SSIM_WINDOW, "SSIM needs at least 11 × 11 pixels"


def _window(like: Tensor) -> Tensor:
    ramp = torch.arange(SSIM_WINDOW, dtype=like.dtype, device=like.device) - SSIM_WINDOW // 2
    window = torch.exp(-0.5 * (ramp / SSIM_SIGMA) ** 2)
    return window / window.sum()


def normal_degrees(normals: Tensor, target: Tensor, where: Tensor) -> float:
    """Mean angle in degrees between two normal maps [H, W, 3] over the pixels ``where`` [H, W]."""
    a = torch.nn.functional.normalize(normals[where], dim=-1)
    b = torch.nn.functional.normalize(target[where], dim=-1)
    return float(torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))).mean())


def mask_box(mask: Tensor, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the bounding box of a mask [H, W], grown by ``margin`` pixels."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)


def widened(span: slice, size: int) -> slice:
    """``span`` clipped to 0…``size`` and widened to SSIM's window."""
    start = max(min(span.start, size - SSIM_WINDOW), 0)
    return slice(start, min(max(span.stop, start + SSIM_WINDOW), size))
