"""Training images, cropped to the person, and the network input of their poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.capture.capture import Capture, Frame, FrameImages, Split
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.window import motion_window
from rnd_trainer.config import ModelConfig
from rnd_trainer.losses.metrics import SSIM_WINDOW, mask_box, widened
from rnd_trainer.model.model import PoseInput

CROP_MARGIN = 16
"""pixels around the mask's box: the loss must cover Gaussians outside the silhouette"""
MASK_COVERAGE = (0.001, 0.95)
"""range of the share of an image that a usable mask covers"""
MAX_BAD_MASKS = 0.2
"""share of empty or full masks above which training stops"""

_TO_LINEAR = torch.as_tensor(srgb_to_linear(np.arange(256) / 255), dtype=torch.float32)


@dataclass
class TrainingView:
    """One training image, cropped, in 8 bits."""

    frame: Frame
    camera: Camera
    image: NDArray[np.uint8]  # [h, w, 3] sRGB, premultiplied on black
    mask: NDArray[np.uint8]  # [h, w]
    normal: NDArray[np.uint8] | None  # [h, w, 3] camera axes, (n + 1)/2; black where unknown inside the mask
    albedo_estimate: NDArray[np.uint8] | None  # [h, w, 3] sRGB, premultiplied; black where unknown

    def target(self, background: Tensor) -> tuple[Tensor, Tensor]:
        """Linear image [h, w, 3] over ``background`` [3] (linear), and the mask [h, w] in 0…1."""
        mask = torch.from_numpy(self.mask).float() / 255
        return _TO_LINEAR[torch.from_numpy(self.image).int()] + (1 - mask[..., None]) * background, mask

    def normals(self) -> tuple[Tensor, Tensor] | None:
        """Normals [h, w, 3] in camera axes, zero outside the mask, and where the loss counts [h, w, 1]; or None."""
        if self.normal is None:
            return None
        covered = torch.from_numpy(_covered(self.mask))[..., None]
        coded = torch.from_numpy(self.normal)
        return (coded.float() / 127.5 - 1) * covered, (coded > 0).any(-1, keepdim=True) | ~covered

    def estimated_albedo(self) -> tuple[Tensor, Tensor] | None:
        """Estimated linear albedo [h, w, 3] and where it is known inside the mask [h, w]; or None."""
        if self.albedo_estimate is None:
            return None
        coded, coverage = torch.from_numpy(self.albedo_estimate), torch.from_numpy(self.mask).float() / 255
        known = (coded > 0).any(-1) & torch.from_numpy(_covered(self.mask))
        return _TO_LINEAR[coded.int()] / coverage.clamp(min=0.5)[..., None], known


def load_views(
    capture: Capture, split: Split, scale: float = 1.0, true_normals: bool = False
) -> tuple[list[TrainingView], list[int]]:
    """Usable views of a split, and the motion frames whose masks are empty or full.

    Args:
        scale: of the images.
        true_normals: take the capture's exact normals instead of the estimated ones.

    Raises:
        InputError: an empty split, an image too small for SSIM, or more than ``MAX_BAD_MASKS`` unusable masks.
    """
    frames = _frames(capture, split)
    if true_normals:
        check_true_normals(capture, frames)
    views, bad = [], []
    for frame in frames:
        data = capture.load_frame(frame)
        if not usable(data.mask):
            bad.append(frame.frame)
            continue
        normal = data.normal_gt if true_normals else data.normal
        camera = capture.cameras[frame.camera]
        if min(camera.width, camera.height) * scale < SSIM_WINDOW:
            raise InputError(
                "training images",
                expected=f"at least {SSIM_WINDOW} pixels wide and high",
                got=f"{camera.width} x {camera.height}, times {scale:g}",
                file=capture.folder,
                frame=frame.frame,
            )
        views.append(_crop(frame, camera, data, normal, scale))
    if len(bad) > MAX_BAD_MASKS * len(frames):
        raise InputError(
            "masks",
            expected=f"at most {MAX_BAD_MASKS:.0%} empty or full",
            got=f"{len(bad)} of {len(frames)}",
            file=capture.folder,
            frame=bad[0],
        )
    return views, bad


def _frames(capture: Capture, split: Split) -> list[Frame]:
    frames = capture.split(split)
    if not frames:
        raise InputError(f"split {split!r}", expected="at least one frame", got="none", file=capture.folder)
    return frames


def check_true_normals(capture: Capture, frames: Iterable[Frame], what: str = "--normals true") -> None:
    """Raise ``InputError``, naming the option ``what``, if one of ``frames`` has no exact normals."""
    for frame in frames:
        if frame.normal_gt is None:
            expected = "normal_gt of every training image"
            raise InputError(what, expected=expected, got="none", file=capture.folder, frame=frame.frame)


def usable(mask: NDArray[np.floating[Any]]) -> bool:
    """Whether ``mask`` [H, W] is neither empty nor full."""
    low, high = MASK_COVERAGE
    return low < float(mask.mean()) < high


def _crop(frame: Frame, camera: Camera, data: FrameImages, normal, scale: float) -> TrainingView:
    image, mask, albedo = data.image_srgb, data.mask, data.albedo_estimate_srgb
    if scale != 1.0:
        camera = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        image, albedo = _shrink(image, camera, srgb=True), _shrink(albedo, camera, srgb=True)
        mask, normal = _shrink(mask, camera), _shrink(normal, camera)
    rows, columns = mask_box(torch.from_numpy(mask > 0), CROP_MARGIN)
    rows, columns = widened(rows, camera.height), widened(columns, camera.width)
    K = camera.K.copy()
    K[0, 2] -= columns.start
    K[1, 2] -= rows.start
    crop = replace(camera, width=columns.stop - columns.start, height=rows.stop - rows.start, K=K)
    coverage = _bytes(mask[rows, columns])
    estimate = None if albedo is None else _bytes(albedo[rows, columns])
    if normal is not None:
        unknown = _covered(coverage) & ~normal[rows, columns].any(-1)
        normal = np.round((normal[rows, columns] + 1) * 127.5).astype(np.uint8)
        normal[unknown] = 0  # no unit normal
    return TrainingView(frame, crop, _bytes(image[rows, columns]), coverage, normal, estimate)


def _bytes(image: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.round(image * 255).astype(np.uint8)


def _covered(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return mask > 127


def _shrink(image, camera: Camera, *, srgb: bool = False):
    """Area averages of ``image`` for a smaller camera; colours are averaged in linear space."""
    if image is None:
        return None
    import cv2

    from rnd_runtime.core.images import linear_to_srgb

    linear = np.ascontiguousarray(srgb_to_linear(image) if srgb else image, np.float32)
    averaged = cv2.resize(linear, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return linear_to_srgb(averaged) if srgb else averaged


def pose_input(motion: Motion, skeleton: Skeleton, time: float, config: ModelConfig) -> PoseInput:
    """Network input of ``motion`` at ``time`` seconds."""
    window, velocity = motion_window(motion, time, poses=config.window_poses, seconds=config.window_seconds)
    now = motion.at(np.array([time]))
    bones = skinning_bones(skeleton, now.rotations[0], now.translations[0])
    return PoseInput(*(torch.as_tensor(np.asarray(x), dtype=torch.float32) for x in (window, velocity, bones)))
