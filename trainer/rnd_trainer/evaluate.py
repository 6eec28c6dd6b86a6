"""Held-out quality of a trained avatar: novel views, novel poses, new lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.capture import Capture, Frame
from rnd_runtime.capture_format import Split
from rnd_runtime.images import linear_to_srgb, srgb_to_linear
from rnd_runtime.light import Light
from rnd_runtime.shading import Shader

from .checkpoint import Checkpoint
from .data import pose_input
from .judge import Rendered, render_runtime
from .metrics import mask_box, normal_degrees, psnr, ssim
from .perceptual import Perceptual

HELD_OUT: tuple[Split, ...] = ("novel_view", "novel_pose", "relight")
BOX_MARGIN = 8
"""pixels around the mask's box in which the second figure of each pair is computed"""


@dataclass
class SplitScore:
    """Means over the frames of one split; ``*_box`` inside the mask's bounding box only.

    The full frame is nine tenths black background, so its figures flatter everybody. ``lpips`` is of the full
    frame, None where no weights were given.
    """

    split: str
    frames: int
    psnr: float
    ssim: float
    psnr_box: float
    ssim_box: float
    normal_deg: float
    lpips: float | None


def evaluate(
    checkpoint: Checkpoint,
    capture: Capture,
    split: Split,
    *,
    mode: str = "table+sun",
    albedo_scale: Tensor | None = None,
    perceptual: Perceptual | None = None,
    on_frame: Callable[[Frame, Rendered, Tensor], None] | None = None,
) -> SplitScore:
    """Score one split. Unknown lights come from the capture, the training light from the learned probe.

    Args:
        albedo_scale: [3] factor on the albedo, for relighting with the albedo–light ambiguity taken out.
        perceptual: LPIPS of these weights is reported too.
        on_frame: called with each frame, its rendering and the true image [H, W, 3] (sRGB).
    """
    shaders: dict[str | None, Shader] = {}
    rows: list[tuple[float, ...]] = []
    trained = {frame.light for frame in capture.split("train")}
    for frame in capture.split(split):
        if frame.light not in shaders:
            if frame.light is None or frame.light in trained:
                light = Light(checkpoint.probe.numpy())
            else:
                light = capture.load_light(frame.light)
            shaders[frame.light] = Shader(light, mode)
        pose = pose_input(
            capture.motion, checkpoint.skeleton, frame.frame / capture.motion.fps, checkpoint.config.model
        )
        rendered = render_runtime(
            checkpoint.model, pose, capture.cameras[frame.camera], shaders[frame.light], albedo_scale
        )
        truth = capture.load_frame(frame)
        target, mask = torch.from_numpy(truth.image_srgb), torch.from_numpy(truth.mask)
        image = to_srgb8(rendered.image)
        box = mask_box(mask > 0, BOX_MARGIN)
        normal = truth.normal_gt if truth.normal_gt is not None else truth.normal
        inside = (mask > 0.5) & (rendered.alpha > 0.5)
        angle = (
            float("nan")
            if normal is None
            else normal_degrees(rendered.normals, torch.from_numpy(normal), inside)
        )
        row = [
            psnr(image, target),
            ssim(image, target),
            psnr(image[box], target[box]),
            ssim(image[box], target[box]),
        ]
        distance = None if perceptual is None else float(perceptual(image, target))
        rows.append((*row, angle, *([] if distance is None else [distance])))
        if on_frame is not None:
            on_frame(frame, rendered, target)
    means = [float(x) for x in np.mean(rows, axis=0)]
    lpips = means.pop() if perceptual is not None else None
    image_psnr, image_ssim, box_psnr, box_ssim, angle = means
    return SplitScore(split, len(rows), image_psnr, image_ssim, box_psnr, box_ssim, angle, lpips)


def albedo_scale(checkpoint: Checkpoint, capture: Capture) -> Tensor | None:
    """Per-channel least-squares factor [3] from the learned to the true albedo, over training frames that have it.

    Albedo and light are known up to this factor; IntrinsicAvatar's protocol fits it before relighting.
    None where the capture has no albedo.
    """
    ours, theirs = [], []
    shader = Shader(Light(checkpoint.probe.numpy()), "ao")
    for frame in capture.split("train"):
        truth = capture.load_frame(frame)
        if truth.albedo_srgb is None:
            continue
        pose = pose_input(
            capture.motion, checkpoint.skeleton, frame.frame / capture.motion.fps, checkpoint.config.model
        )
        rendered = render_runtime(checkpoint.model, pose, capture.cameras[frame.camera], shader)
        inside = (torch.from_numpy(truth.mask) > 0.99) & (rendered.alpha > 0.99)
        ours.append(rendered.albedo[inside])
        theirs.append(torch.from_numpy(srgb_to_linear(truth.albedo_srgb)).float()[inside])
    if not ours:
        return None
    x, y = torch.cat(ours), torch.cat(theirs)
    return (x * y).sum(0) / (x * x).sum(0)


def to_srgb8(image: Tensor) -> Tensor:
    """Linear premultiplied [H, W, 3] on black → sRGB as a PNG holds it."""
    return torch.from_numpy(np.round(np.clip(linear_to_srgb(image.numpy()), 0, 1) * 255) / 255).float()
