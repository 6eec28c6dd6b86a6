"""Training pictures, cropped to the person, and the pose that goes with each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.capture.capture import Capture, Frame, Split
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.window import motion_window
from rnd_runtime.shading.light import Light
from rnd_trainer.config import ModelConfig
from rnd_trainer.losses.metrics import SSIM_WINDOW, mask_box, widened
from rnd_trainer.model.model import PoseInput

CROP_MARGIN = 16
"""pixels around the mask's box: what spills over the silhouette must be seen to be punished"""
MASK_COVERAGE = (0.001, 0.95)
"""share of the picture that a usable mask covers"""
MAX_BAD_MASKS = 0.2
"""share of empty or full masks above which training stops"""

_TO_LINEAR = torch.as_tensor(srgb_to_linear(np.arange(256) / 255), dtype=torch.float32)


@dataclass
class TrainingView:
    """One training picture: a crop, kept in 8 bits until it is used.

    image [h, w, 3] sRGB premultiplied on black, mask [h, w], normal [h, w, 3] as (n + 1)/2, or black where the
    estimate has no data inside the mask, or None.
    """

    frame: Frame
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    normal: NDArray[np.uint8] | None

    def target(self, background: Tensor) -> tuple[Tensor, Tensor]:
        """Linear image [h, w, 3] over ``background`` [3] (linear), and the mask [h, w] in 0…1."""
        mask = torch.from_numpy(self.mask).float() / 255
        return _TO_LINEAR[torch.from_numpy(self.image).int()] + (1 - mask[..., None]) * background, mask

    def normals(self) -> tuple[Tensor, Tensor] | None:
        """Estimated normals [h, w, 3], camera axes, zero outside the mask, and where they are known [h, w, 1].

        Outside the mask they are, by being none. None where the view has no estimate at all.
        """
        if self.normal is None:
            return None
        covered = torch.from_numpy(_covered(self.mask))[..., None]
        coded = torch.from_numpy(self.normal)
        return (coded.float() / 127.5 - 1) * covered, (coded > 0).any(-1, keepdim=True) | ~covered


def load_views(
    capture: Capture, split: Split, scale: float = 1.0, true_normals: bool = False
) -> tuple[list[TrainingView], list[int]]:
    """The usable views of a split, and the motion frames whose masks were empty or full.

    ``true_normals`` takes the capture's exact normals instead of the estimated ones (an oracle, for studies).

    Raises ``InputError`` when the split is empty or more than a fifth of its masks are unusable.
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
                "training pictures",
                expected=f"at least {SSIM_WINDOW} pixels wide and high",
                got=f"{camera.width} x {camera.height}, times {scale:g}",
                file=capture.folder,
                frame=frame.frame,
            )
        views.append(_crop(frame, camera, data.image_srgb, data.mask, normal, scale))
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
    """Raise ``InputError`` where one of ``frames`` has no exact normals, which ``what`` asks for."""
    for frame in frames:
        if frame.normal_gt is None:
            expected = "normal_gt of every training picture"
            raise InputError(what, expected=expected, got="none", file=capture.folder, frame=frame.frame)


def training_light(capture: Capture, what: str = "--light capture") -> tuple[str, Light]:
    """The light that all training pictures were taken under, and its name; ``what`` asks for it.

    Raises ``InputError`` where there are several, or the capture does not have it.
    """
    name = training_light_name(capture, what)
    return name, capture.load_light(name)


def training_light_name(capture: Capture, what: str) -> str:
    """The name of the one light that all training pictures were taken under, "unknown" where it has none.

    Raises ``InputError`` where there are several, or no training pictures.
    """
    names = light_names(_frames(capture, "train"))
    if len(names) != 1:
        got = ", ".join(names)
        raise InputError(what, expected="one light in the train split", got=got, file=capture.folder)
    return names[0]


def light_names(frames: Iterable[Frame]) -> list[str]:
    """Names of the lights that ``frames`` were taken under, each once, "unknown" where one has none."""
    return sorted({frame.light or "unknown" for frame in frames})


def usable(mask: NDArray[np.floating[Any]]) -> bool:
    """Whether a picture with ``mask`` [H, W] shows a person, whole or in part."""
    low, high = MASK_COVERAGE
    return low < float(mask.mean()) < high


def _crop(frame: Frame, camera: Camera, image, mask, normal, scale: float) -> TrainingView:
    if scale != 1.0:
        image, mask, normal, camera = _shrink(image, mask, normal, camera, scale)
    rows, columns = mask_box(torch.from_numpy(mask > 0), CROP_MARGIN)
    rows, columns = widened(rows, camera.height), widened(columns, camera.width)
    K = camera.K.copy()
    K[0, 2] -= columns.start
    K[1, 2] -= rows.start
    crop = replace(camera, width=columns.stop - columns.start, height=rows.stop - rows.start, K=K)
    coverage = np.round(mask[rows, columns] * 255).astype(np.uint8)
    if normal is not None:
        unknown = _covered(coverage) & ~normal[rows, columns].any(-1)
        normal = np.round((normal[rows, columns] + 1) * 127.5).astype(np.uint8)
        normal[unknown] = 0  # which is nobody's normal
    return TrainingView(frame, crop, np.round(image[rows, columns] * 255).astype(np.uint8), coverage, normal)


def _covered(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return mask > 127


def _shrink(image, mask, normal, camera: Camera, scale: float):
    """Area-averaged to ``scale``; colours are averaged as light, not as sRGB."""
    import cv2

    from rnd_runtime.core.images import linear_to_srgb

    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    size = (small.width, small.height)

    def area(x):
        return cv2.resize(np.ascontiguousarray(x, np.float32), size, interpolation=cv2.INTER_AREA)

    normal = None if normal is None else area(normal)
    return linear_to_srgb(area(srgb_to_linear(image))), area(mask), normal, small


def pose_input(motion: Motion, skeleton: Skeleton, time: float, config: ModelConfig) -> PoseInput:
    """Window, velocities and bone transforms of ``motion`` at ``time`` seconds, as tensors."""
    window, velocity = motion_window(motion, time, poses=config.window_poses, seconds=config.window_seconds)
    now = motion.at(np.array([time]))
    bones = skinning_bones(skeleton, now.rotations[0], now.translations[0])
    return PoseInput(*(torch.as_tensor(np.asarray(x), dtype=torch.float32) for x in (window, velocity, bones)))
