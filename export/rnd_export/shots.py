"""What a bound's search looks at: moments and cameras, one half to search in and another to test what was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rnd_runtime.camera import Camera
from rnd_runtime.capture import Capture, Frame
from rnd_runtime.errors import InputError
from rnd_runtime.gaussians import Gaussians
from rnd_runtime.motion import Motion

COUNT = 6
"""to search in; as many others are held out"""
FIELD_OF_VIEW = 0.6


@dataclass(frozen=True, eq=False)
class Shot:
    """A moment of the motion and where it is seen from; equal to itself alone, since those of one pose share a time."""

    time: float
    camera: Camera


class Shots(NamedTuple):
    """``seen`` are searched in; ``held_out`` are not."""

    seen: list[Shot]
    held_out: list[Shot]


def shots_around(motion: Motion, size: int, pose: Callable[[float], Gaussians]) -> Shots:
    """Moments all along ``motion``, by turns, each from another side in a picture that the avatar just fills."""
    times = (np.arange(2 * COUNT) + 0.5) / (2 * COUNT) * motion.duration
    shots = [Shot(float(t), _around(pose(float(t)), size, k)) for k, t in enumerate(times)]
    return Shots(shots[::2], shots[1::2])


def shots_of(capture: Capture, size: int) -> Shots:
    """Training views of ``capture``; held out are its other poses, or training views in between where it has none.

    Pictures are resized to ``size`` pixels on their longer side. Raises :class:`InputError` for fewer than two views.
    """
    train, others = capture.split("train"), capture.split("novel_pose")
    if len(train) < 2:
        raise InputError(
            "training views of the capture", expected="at least 2", got=len(train), file=capture.file
        )
    if others:
        return Shots(
            *([_shot(capture, frame, size) for frame in _spread(frames)] for frames in (train, others))
        )
    return Shots(*([_shot(capture, frame, size) for frame in _spread(train[k::2])] for k in (0, 1)))


def resized(camera: Camera, side: int) -> Camera:
    """The same view, its longer side of ``side`` pixels."""
    share = side / max(camera.width, camera.height)
    return camera.resized(*(max(1, round(share * pixels)) for pixels in (camera.width, camera.height)))


def _spread(frames: list[Frame]) -> list[Frame]:
    """``COUNT`` of them at even distances, or all where there are no more."""
    return [frames[k * len(frames) // COUNT] for k in range(COUNT)] if len(frames) > COUNT else frames


def _shot(capture: Capture, frame: Frame, size: int) -> Shot:
    return Shot(frame.frame / capture.motion.fps, resized(capture.cameras[frame.camera], size))


def _around(gaussians: Gaussians, size: int, number: int) -> Camera:
    low, high = gaussians.means.min(0), gaussians.means.max(0)
    centre = (low + high) / 2
    distance = 0.6 * float(np.linalg.norm(high - low)) / np.tan(FIELD_OF_VIEW / 2)
    angle = 2 * np.pi * 0.381966 * number  # the golden angle: no two from one side
    eye = centre + distance * np.array([np.sin(angle), 0.1, np.cos(angle)])
    return Camera.look_at(eye, centre, width=size, height=size, fov_y=FIELD_OF_VIEW)
