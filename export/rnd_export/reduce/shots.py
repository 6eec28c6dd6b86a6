"""What a bound's search looks at: moments and cameras to search in, more of the same kind to fit what is merged in, and
others to test what was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.motion import Motion

COUNT = 6
"""to search in; as many others are held out"""
FITTED = 24
"""to fit in: of six the merged avatar learns what they show, 1 to 2 dB worse in others (the dancer)"""
FIELD_OF_VIEW = 0.6


@dataclass(frozen=True, eq=False)
class Shot:
    """A moment of the motion and where it is seen from; equal to itself alone, since those of one pose share a time."""

    time: float
    camera: Camera


class Shots(NamedTuple):
    """``seen`` are searched in, ``fitted`` tell contributions and colours; ``held_out`` are for neither."""

    seen: list[Shot]
    fitted: list[Shot]
    held_out: list[Shot]


def shots_around(motion: Motion, size: int, pose: Callable[[float], Gaussians]) -> Shots:
    """Moments all along ``motion``, by turns, each from another side in a picture that the avatar just fills.

    Fitted are the moments of the search, from more sides.
    """
    times = (np.arange(2 * COUNT) + 0.5) / (2 * COUNT) * motion.duration
    posed = [(float(t), pose(float(t))) for t in times]

    def shots(first: int, rounds: int) -> list[Shot]:
        sides = [(k, number) for number in range(rounds) for k in range(first, 2 * COUNT, 2)]
        return [Shot(posed[k][0], _around(posed[k][1], size, k + 2 * COUNT * number)) for k, number in sides]

    return Shots(shots(0, 1), shots(0, FITTED // COUNT), shots(1, 1))


def shots_of(capture: Capture, size: int) -> Shots:
    """Training views of ``capture``; held out are its other poses, or training views in between where it has none.

    Pictures are resized to ``size`` pixels on their longer side. Raises ``InputError`` for fewer than two views.
    """
    train, others = capture.split("train"), capture.split("novel_pose")
    if len(train) < 2:
        raise InputError("training views of the capture", expected="at least 2", got=len(train), file=capture.file)
    if not others:
        train, others = train[::2], train[1::2]

    def shots(frames: list[Frame], count: int) -> list[Shot]:
        return [_shot(capture, frame, size) for frame in _spread(frames, count)]

    return Shots(shots(train, COUNT), shots(train, FITTED), shots(others, COUNT))


def resized(camera: Camera, side: int) -> Camera:
    """The same view, its longer side of ``side`` pixels."""
    share = side / max(camera.width, camera.height)
    return camera.resized(*(max(1, round(share * pixels)) for pixels in (camera.width, camera.height)))


def _spread(frames: list[Frame], count: int) -> list[Frame]:
    """``count`` of them at even distances, or all where there are no more."""
    return [frames[k * len(frames) // count] for k in range(count)] if len(frames) > count else frames


def _shot(capture: Capture, frame: Frame, size: int) -> Shot:
    return Shot(frame.frame / capture.motion.fps, resized(capture.cameras[frame.camera], size))


def _around(gaussians: Gaussians, size: int, number: int) -> Camera:
    low, high = gaussians.means.min(0), gaussians.means.max(0)
    centre = (low + high) / 2
    distance = 0.6 * float(np.linalg.norm(high - low)) / np.tan(FIELD_OF_VIEW / 2)
    angle = 2 * np.pi * 0.381966 * number  # the golden angle: no two from one side
    eye = centre + distance * np.array([np.sin(angle), 0.1, np.cos(angle)])
    return Camera.look_at(eye, centre, width=size, height=size, fov_y=FIELD_OF_VIEW)
