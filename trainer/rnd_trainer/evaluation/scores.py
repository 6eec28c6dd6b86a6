"""What one rendering is worth beside its truth: image, normals and albedo, whole frame and the person's box."""

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
"""pixels around the mask's box in which the second figure of each pair is computed"""
EDGE = 4
"""pixels on either side of the silhouette that are the truth's own in `lpips_inner`"""
COVERED = 0.05
"""coverage below which a pixel has no normal, in the truth as in ours"""


def frame_scores(
    rendered: Rendered, truth: FrameImages, perceptual: Perceptual | None = None, scale: Tensor | None = None
) -> dict[str, float]:
    """Figures of one picture by name; what the capture or the weights do not allow is left out.

    ``psnr, ssim, lpips`` of the sRGB picture on black, in the full frame and (``*_box``) in the mask's bounding
    box: the full frame is nine tenths background, so its figures flatter everybody. ``psnr_n, ssim_n`` of normal
    pictures (n + 1)/2, ``normal_deg`` the mean angle, both where the truth has normals; ``psnr_albedo`` of sRGB, after
    ``scale`` [3], where mask and render both cover more than half. ``lpips_inner`` has the outline from the truth;
    ``outline_px`` is the area that coverage is wrong by, per length of outline.
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
    length = outline_length(mask)
    if length > 0:
        scores["outline_px"] = float((rendered.alpha - mask).abs().sum()) / length
    if perceptual is not None and min(image.shape[:2]) >= perceptual.smallest:
        scores["lpips"] = float(perceptual(image, target))
        scores["lpips_inner"] = float(perceptual(torch.where(silhouette(mask), target, image), target))
        if min(image[box].shape[:2]) >= perceptual.smallest:
            scores["lpips_box"] = float(perceptual(image[box], target[box]))
    inside = (mask > 0.5) & (rendered.alpha > 0.5)
    normal = truth.normal_gt if truth.normal_gt is not None else truth.normal
    if normal is not None:
        expected = torch.from_numpy(normal).float()
        known = expected.any(-1)
        if (inside & known).any():
            scores["normal_deg"] = normal_degrees(rendered.normals, expected, inside & known)
        hole = ((mask > COVERED) & ~known)[..., None]
        ours = normal_picture(rendered.normals, rendered.alpha).masked_fill(hole, 0)
        theirs = normal_picture(expected, mask).masked_fill(hole, 0)
        scores |= {
            "psnr_n": psnr(ours, theirs),
            "ssim_n": ssim(ours, theirs),
            "psnr_n_box": psnr(ours[box], theirs[box]),
        }
    if truth.albedo_srgb is not None and inside.any():
        albedo = rendered.albedo if scale is None else rendered.albedo * scale
        expected = torch.from_numpy(truth.albedo_srgb).float()
        scores["psnr_albedo"] = psnr(to_srgb8(albedo), expected, inside)
    return scores


def silhouette(mask: Tensor) -> Tensor:
    """Pixels [H, W, 1] within ``EDGE`` of where coverage [H, W] passes a half."""
    covered = (mask > 0.5).float()[None]
    near_person, near_nothing = (
        torch.nn.functional.max_pool2d(side, 2 * EDGE + 1, stride=1, padding=EDGE) for side in (covered, 1 - covered)
    )
    return (near_person * near_nothing)[0, ..., None] > 0


def outline_length(mask: Tensor) -> float:
    """Length in pixels of the outline of coverage [H, W]: its total variation ∫|∇m| (the coarea formula)."""
    down, right = torch.gradient(mask)
    return float(torch.hypot(down, right).sum())


def normal_picture(normals: Tensor, coverage: Tensor) -> Tensor:
    """Unit normals [H, W, 3] as a picture (n + 1)/2, black where less than 5 % is covered [H, W]."""
    unit = torch.nn.functional.normalize(normals, dim=-1)
    return torch.where((coverage > COVERED)[..., None], (unit + 1) / 2, torch.zeros_like(unit))


def to_srgb8(image: Tensor) -> Tensor:
    """Linear premultiplied [H, W, 3] on black → sRGB as a PNG holds it."""
    return torch.from_numpy(np.round(np.clip(linear_to_srgb(image.numpy()), 0, 1) * 255) / 255).float()
