"""Views of a search: some to search in, more to fit merged Gaussians to, and held-out ones."""

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

COUNT = 6  # views to search in, and held-out ones
FIT_COUNT = 24  # views to fit in; with six the dancer loses 1 to 2 dB in other views
FIELD_OF_VIEW = 0.6
GOLDEN_ANGLE = 2 * np.pi * 0.381966  # rad, between consecutive views


@dataclass(frozen=True, eq=False)
class SearchView:
    """A time of the motion (s) and a camera; compared by identity."""

    time: float
    camera: Camera


class SearchViews(NamedTuple):
    """``search``: to search in. ``fitted``: for contributions and colours. ``held_out``: for neither."""

    search: list[SearchView]
    fitted: list[SearchView]
    held_out: list[SearchView]


def views_around(motion: Motion, size: tuple[int, int], pose: Callable[[float], Gaussians]) -> SearchViews:
    """Views along ``motion``, alternating between search and held-out, each framing the avatar in (width, height)."""
    times = (np.arange(2 * COUNT) + 0.5) / (2 * COUNT) * motion.duration
    posed = [(float(t), pose(float(t))) for t in times]

    def views(first: int, rounds: int) -> list[SearchView]:
        sides = [(k, number) for number in range(rounds) for k in range(first, 2 * COUNT, 2)]
        return [SearchView(posed[k][0], _around(posed[k][1], size, k + 2 * COUNT * number)) for k, number in sides]

    return SearchViews(views(0, 1), views(0, FIT_COUNT // COUNT), views(1, 1))


def views_of(capture: Capture, size: int, hold_out: bool = False) -> SearchViews:
    """Training views of ``capture``, ``size`` pixels on the longer side.

    Held out are its novel poses, or else every other training view; with ``hold_out`` what the training held out.
    """
    if hold_out:
        capture = capture.holding_out()
    train, others = capture.split("train"), capture.split("validation" if hold_out else "novel_pose")
    if len(train) < 2:
        raise InputError("training views of the capture", expected="at least 2", got=len(train), file=capture.file)
    if not others:
        train, others = train[::2], train[1::2]

    def views(frames: list[Frame], count: int) -> list[SearchView]:
        if len(frames) > count:
            frames = [frames[k * len(frames) // count] for k in range(count)]
        cameras = [resized(capture.cameras[frame.camera], size) for frame in frames]
        return [SearchView(frame.frame / capture.motion.fps, camera) for frame, camera in zip(frames, cameras)]

    return SearchViews(views(train, COUNT), views(train, FIT_COUNT), views(others, COUNT))


def resized(camera: Camera, side: int) -> Camera:
    """The same view with a longer side of ``side`` pixels."""
    share = side / max(camera.width, camera.height)
    return camera.resized(*(max(1, round(share * pixels)) for pixels in (camera.width, camera.height)))


def _around(gaussians: Gaussians, size: tuple[int, int], number: int) -> Camera:
    low, high = gaussians.means.min(0), gaussians.means.max(0)
    centre = (low + high) / 2
    distance = 0.6 * float(np.linalg.norm(high - low)) / np.tan(FIELD_OF_VIEW / 2)
    angle = GOLDEN_ANGLE * number
    eye = centre + distance * np.array([np.sin(angle), 0.1, np.cos(angle)])
    return Camera.look_at(eye, centre, width=size[0], height=size[1], fov_y=FIELD_OF_VIEW)
