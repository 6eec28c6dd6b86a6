"""Frames of a video without the distortion of its lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.images import Bytes, pinhole, undistort_image


@dataclass(frozen=True, eq=False)
class Undistorted:
    """A ``video`` whose frames are undistorted on reading.

    Attributes:
        camera: of its frames; the pose is not used.
        distortion: OpenCV's k1 k2 p1 p2 [k3 …].
    """

    video: Any
    camera: Camera
    distortion: tuple[float, ...]

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "video"), name)

    def frame(self, number: int) -> Bytes:
        return undistort_image(self.video.frame(number), self.camera, self.distortion)


def undistorted(video: Any, intrinsics: tuple[float, ...], distortion: tuple[float, ...]) -> Any:
    """``video`` without ``distortion`` of a lens of ``intrinsics`` fx fy cx cy, pixels; as it is where there is none.

    Raises:
        InputError: distortion without intrinsics.
    """
    if not any(distortion):
        return video
    if len(intrinsics) != 4:
        raise InputError("--distortion", expected="--intrinsics fx fy cx cy with it", got="none")
    camera = Camera(video.width, video.height, pinhole(*intrinsics), np.eye(4))
    return Undistorted(video, camera, distortion)
