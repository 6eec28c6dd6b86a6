"""Explanations of a misaligned template: the IoU with each usual mistake undone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.rotations import axis_angle_to_matrix

from .views import MaskView, mean_iou, with_pose

Floats = NDArray[np.float64]

GAIN = 0.04
"""IoU that an explanation must gain; on a correct capture the best one loses 0.06"""
TIME_GAIN = 0.02
"""IoU that another timing must gain; one frame off costs a walker at 30 fps about 0.03"""
MIN_IOU = 0.4
"""IoU that an explanation must reach: what fits less explains nothing"""
SHIFTS = (-3, -2, -1, 1, 2, 3)
STRIDES = (0.5, 0.8, 5 / 6, 1.2, 1.25, 2.0)

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_QUARTER = axis_angle_to_matrix([np.pi / 2, 0, 0])


@dataclass(frozen=True)
class Explanation:
    """A mistake in words, and the mean IoU without it."""

    sentence: str
    iou: float


def _candidates(rest: Floats, world: Floats) -> list[tuple[str, Callable[[MaskView], MaskView]]]:
    """Known mistakes as (sentence, correction).

    Args:
        rest: [3] m, the root's rest position.
        world: [3, 3] rotation of the source's world by the import.
    """
    offset = world @ rest

    def move(view: MaskView, position: Floats) -> MaskView:
        return view.with_root(view.root_rotation, position)

    def rotate(view: MaskView, rotation: Floats) -> MaskView:
        return view.with_root(rotation @ view.root_rotation, rotation @ view.root_position)

    def camera(view: MaskView, change: Callable[[Floats], Floats]) -> MaskView:
        return view.with_camera(world_to_camera=change(view.camera.world_to_camera))

    def scale_K(view: MaskView, factor: float) -> MaskView:
        return view.with_camera(K=np.diag([factor, factor, 1.0]) @ view.camera.K)

    def inverse(matrix: Floats) -> Floats:
        return np.asarray(np.linalg.inv(matrix), np.float64)

    millimetres = np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
    return [
        (
            "the root rotation looks like EasyMocap's Rh/Th; try --root easymocap",
            lambda v: move(v, v.root_position + v.root_rotation @ rest - offset),
        ),
        (
            "the root rotation looks like plain SMPL's, read as EasyMocap's Rh/Th; try --root smpl",
            lambda v: move(v, v.root_position - v.root_rotation @ rest + offset),
        ),
        ("trans looks like the pelvis position, not its offset from rest", lambda v: move(v, v.root_position - offset)),
        ("the pelvis position looks subtracted from trans twice", lambda v: move(v, v.root_position + offset)),
        ("the root rotation looks transposed", lambda v: v.with_root(v.root_rotation.T, v.root_position)),
        ("the motion looks Z up where the cameras are Y up: rotate one of them", lambda v: rotate(v, _QUARTER.T)),
        ("the motion looks Y up where the cameras are Z up: rotate one of them", lambda v: rotate(v, _QUARTER)),
        ("the motion looks Y down: rotate it by 180° about X", lambda v: rotate(v, _FLIP[:3, :3])),
        ("world_to_camera looks like camera-to-world: invert it", lambda v: camera(v, inverse)),
        (
            "the cameras look like OpenGL's (Y up, looking along -Z): flip their y and z",
            lambda v: camera(v, lambda m: _FLIP @ m),
        ),
        (
            "world_to_camera looks like OpenGL's camera-to-world: flip y and z, then invert it",
            lambda v: camera(v, lambda m: inverse(m @ _FLIP)),
        ),
        (
            "the cameras' translations look like millimetres: divide by 1000",
            lambda v: camera(v, lambda m: m * millimetres),
        ),
        (
            "the cameras' translations look like metres taken for millimetres: multiply by 1000",
            lambda v: camera(v, lambda m: m / millimetres),
        ),
        ("trans looks like millimetres: divide by 1000", lambda v: move(v, offset + (v.root_position - offset) / 1000)),
        ("K looks made for images of twice the size: halve it", lambda v: scale_K(v, 0.5)),
        ("K looks made for images of half the size: double it", lambda v: scale_K(v, 2.0)),
    ]


def explain(rest: Floats, world: Floats, views: list[MaskView]) -> Explanation | None:
    """Best explanation of a poor fit, or None; arguments as ``_candidates``.

    Inverted masks come first: a template that fills the image fits them as well.
    """
    current = mean_iou(views)
    inverted = _inverted(views)
    if inverted is not None and inverted.iou > max(current + GAIN, MIN_IOU):
        return inverted
    found = [Explanation(s, mean_iou([change(view) for view in views])) for s, change in _candidates(rest, world)]
    best = max(found, key=lambda explanation: explanation.iou)
    return best if best.iou > max(current + GAIN, MIN_IOU) else None


def _inverted(views: list[MaskView]) -> Explanation | None:
    """The fit of the masks' complements, where the masks cover most of the images' borders, or None."""
    borders = [np.concatenate([v.mask[0], v.mask[-1], v.mask[:, 0], v.mask[:, -1]]).mean() for v in views]
    if np.mean(borders) <= 0.5:
        return None
    return Explanation("the masks look inverted: invert them", mean_iou([replace(v, mask=~v.mask) for v in views]))


def explain_timing(capture: Capture, views: list[MaskView]) -> Explanation | None:
    """Another relation between images and motion frames that fits better, or None."""
    candidates: list[tuple[str, Callable[[int], int]]] = []
    for shift in SHIFTS:
        when = f"{abs(shift)} frame{'s' * (abs(shift) > 1)} {'late' if shift > 0 else 'early'}"
        candidates.append((f"the motion looks {when}: image k shows motion frame k{shift:+d}", shift.__add__))
    for rate in STRIDES:
        sentence = f"the motion looks sampled at {rate:.3g} times the rate of the images"
        candidates.append((sentence, lambda k, rate=rate: round(rate * k)))  # type: ignore[misc]
    best, gain = None, TIME_GAIN
    for sentence, index in candidates:
        pairs = [(view, index(view.frame.frame)) for view in views]
        pairs = [(v, k) for v, k in pairs if k != v.frame.frame and 0 <= k < capture.motion.frame_count]
        if len(pairs) < min(4, len(views)):
            continue
        here = mean_iou([view for view, _ in pairs])
        there = mean_iou([with_pose(capture, view, k) for view, k in pairs])
        if there - here > gain and there > MIN_IOU:
            best, gain = Explanation(sentence, there), there - here
    return best
