"""Scores of one rendering: image, normals and albedo, in the full frame and the person's box."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.capture.capture import FrameImages
from rnd_runtime.core.images import linear_to_srgb
from rnd_trainer.losses.metrics import mask_box, normal_degrees, psnr, ssim, widened
from rnd_trainer.losses.perceptual import Perceptual

from .evaluator import Rendered

BOX_MARGIN = 8
"""pixels around the mask's bounding box"""
EDGE = 4
"""pixels on either side of the silhouette taken from the truth in `lpips_inner`"""
COVERED = 0.05
"""coverage below which a pixel has no normal"""


def frame_scores(
    rendered: Rendered, truth: FrameImages, perceptual: Perceptual | None = None, scale: Tensor | None = None
) -> dict[str, float]:
    """Scores of one image by name, as far as the capture and the weights allow.

    - ``psnr, ssim, lpips``: sRGB on black, full frame; ``*_box``: in the mask's bounding box; ``psnr_person``: where
      the mask covers more than half.
    - ``psnr_n, ssim_n``: normal images (n + 1)/2; ``normal_deg``: mean angle in degrees.
    - ``psnr_albedo``: sRGB, after ``scale`` [3], where mask and render both cover more than half.
    - ``lpips_inner``: with the outline from the truth.
    - ``outline_px``: area of wrong coverage per length of outline, pixels.
    """
    target, mask = torch.from_numpy(truth.image_srgb).float(), torch.from_numpy(truth.mask)
    image = to_srgb8(rendered.image)
    rows, columns = mask_box(mask > 0, BOX_MARGIN)
    box = widened(rows, mask.shape[0]), widened(columns, mask.shape[1])
    scores = {
        "psnr": psnr(image, target),
        "ssim": ssim(image, target),
        "psnr_box": psnr(image[box], target[box]),
        "ssim_box": ssim(image[box], target[box]),
    }
    inside = mask > 0.5
    if inside.any():
        scores["psnr_person"] = psnr(image, target, inside)
    length = outline_length(mask)
    if length > 0:
        scores["outline_px"] = float((rendered.alpha - mask).abs().sum()) / length
    if perceptual is not None and min(image.shape[:2]) >= perceptual.smallest:
        scores["lpips"] = float(perceptual(image, target))
        scores["lpips_inner"] = float(perceptual(torch.where(silhouette(mask), target, image), target))
        if min(image[box].shape[:2]) >= perceptual.smallest:
            scores["lpips_box"] = float(perceptual(image[box], target[box]))
    inside = inside & (rendered.alpha > 0.5)
    normal = truth.normal_gt if truth.normal_gt is not None else truth.normal
    if normal is not None:
        expected = torch.from_numpy(normal).float()
        known = expected.any(-1)
        if (inside & known).any():
            scores["normal_deg"] = normal_degrees(rendered.normals, expected, inside & known)
        hole = ((mask > COVERED) & ~known)[..., None]
        rendered_image = normal_image(rendered.normals, rendered.alpha).masked_fill(hole, 0)
        true_image = normal_image(expected, mask).masked_fill(hole, 0)
        scores |= {
            "psnr_n": psnr(rendered_image, true_image),
            "ssim_n": ssim(rendered_image, true_image),
            "psnr_n_box": psnr(rendered_image[box], true_image[box]),
        }
    if truth.albedo_srgb is not None and inside.any():
        albedo = rendered.albedo if scale is None else rendered.albedo * scale
        expected = torch.from_numpy(truth.albedo_srgb).float()
        scores["psnr_albedo"] = psnr(to_srgb8(albedo), expected, inside)
    return scores


def silhouette(mask: Tensor) -> Tensor:
    """Pixels [H, W, 1] within ``EDGE`` of the outline of coverage [H, W] at 0.5."""
    covered = (mask > 0.5).float()[None]
    near_person, near_background = (
        torch.nn.functional.max_pool2d(side, 2 * EDGE + 1, stride=1, padding=EDGE) for side in (covered, 1 - covered)
    )
    return (near_person * near_background)[0, ..., None] > 0


def outline_length(mask: Tensor) -> float:
    """Outline length in pixels of coverage [H, W]: its total variation ∫|∇m| (coarea formula)."""
    down, right = torch.gradient(mask)
    return float(torch.hypot(down, right).sum())


def normal_image(normals: Tensor, coverage: Tensor) -> Tensor:
    """Unit normals [H, W, 3] as an image (n + 1)/2, black where ``coverage`` [H, W] is at most ``COVERED``."""
    unit = torch.nn.functional.normalize(normals, dim=-1)
    return torch.where((coverage > COVERED)[..., None], (unit + 1) / 2, torch.zeros_like(unit))


def to_srgb8(image: Tensor) -> Tensor:
    """Linear premultiplied [H, W, 3] on black → sRGB, rounded to 8 bits."""
    return torch.from_numpy(np.round(np.clip(linear_to_srgb(image.numpy()), 0, 1) * 255) / 255).float()
