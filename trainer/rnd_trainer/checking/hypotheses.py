"""What may be wrong with a capture whose template misses its masks: every usual mistake undone, and compared.

Each hypothesis changes the pose or the camera as if one convention had been misread. The one under which the
silhouettes fit best is named, if it fits better than the capture as it stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.rotations import axis_angle_to_matrix

from .views import Sight, mean_overlap, posed

Floats = NDArray[np.float64]

GAIN = 0.04
"""IoU that an explanation must win; none of them comes near a sound capture (measured: 0.06 below it at best)"""
TIME_GAIN = 0.02
"""IoU that another timing must win; a pose one frame off costs a walker at 30 fps about 0.03"""
SHIFTS = (-3, -2, -1, 1, 2, 3)
STRIDES = (0.5, 0.8, 5 / 6, 1.2, 1.25, 2.0)

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_QUARTER = axis_angle_to_matrix([np.pi / 2, 0, 0])


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), np.float64)


@dataclass(frozen=True)
class Verdict:
    """A sentence and the mean IoU it would bring."""

    sentence: str
    overlap: float


def explanations(rest: Floats, world: Floats) -> list[tuple[str, Callable[[Sight], Sight]]]:
    """(sentence, change) of every mistake we know.

    Args:
        rest: [3] m, the root's rest position.
        world: [3, 3] how an import turned the source's world: its conventions hold before that.
    """
    offset = world @ rest

    def at(seen: Sight, joint: Floats) -> Sight:
        return seen.moved(seen.turn, joint)

    def turned(seen: Sight, turn: Floats) -> Sight:
        return seen.moved(turn @ seen.turn, turn @ seen.joint)

    def camera(seen: Sight, change: Callable[[Floats], Floats]) -> Sight:
        return seen.seen_by(world_to_camera=change(seen.camera.world_to_camera))

    def scaled(seen: Sight, factor: float) -> Sight:
        return seen.seen_by(K=np.diag([factor, factor, 1.0]) @ seen.camera.K)

    millimetres = np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
    return [
        (
            "the root rotation looks like EasyMocap's Rh/Th; try --as easymocap",
            lambda s: at(s, s.joint + s.turn @ rest - offset),
        ),
        (
            "the root rotation looks like plain SMPL's, read as EasyMocap's Rh/Th; try --as smpl",
            lambda s: at(s, s.joint - s.turn @ rest + offset),
        ),
        (
            "trans looks like the pelvis's place instead of an offset from its rest position",
            lambda s: at(s, s.joint - offset),
        ),
        ("the pelvis's place looks taken off trans twice", lambda s: at(s, s.joint + offset)),
        ("the root rotation looks transposed", lambda s: s.moved(s.turn.T, s.joint)),
        ("the motion looks Z up where the cameras are Y up: turn one of them", lambda s: turned(s, _QUARTER.T)),
        ("the motion looks Y up where the cameras are Z up: turn one of them", lambda s: turned(s, _QUARTER)),
        ("the motion looks Y down: turn it by 180° about X", lambda s: turned(s, _FLIP[:3, :3])),
        ("world_to_camera looks like camera-to-world: invert it", lambda s: camera(s, _inverse)),
        (
            "the cameras look like OpenGL's (Y up, looking along -Z): flip their y and z",
            lambda s: camera(s, lambda m: _FLIP @ m),
        ),
        (
            "world_to_camera looks like OpenGL's camera-to-world: flip y and z, then invert it",
            lambda s: camera(s, lambda m: _inverse(m @ _FLIP)),
        ),
        (
            "the cameras' translations look like millimetres: divide by 1000",
            lambda s: camera(s, lambda m: m * millimetres),
        ),
        (
            "the cameras' translations look like metres taken for millimetres: multiply by 1000",
            lambda s: camera(s, lambda m: m / millimetres),
        ),
        ("trans looks like millimetres: divide by 1000", lambda s: at(s, offset + (s.joint - offset) / 1000)),
        ("K looks made for pictures of twice the size: halve it", lambda s: scaled(s, 0.5)),
        ("K looks made for pictures of half the size: double it", lambda s: scaled(s, 2.0)),
    ]


def explain(rest: Floats, world: Floats, sights: list[Sight]) -> Verdict | None:
    """The best of ``explanations`` of a poor fit, or None when nothing known makes it better."""
    as_it_is = mean_overlap(sights)
    best = Verdict("", as_it_is)
    for sentence, change in explanations(rest, world):
        score = mean_overlap([change(seen) for seen in sights])
        if score > best.overlap:
            best = Verdict(sentence, score)
    return best if best.overlap > as_it_is + GAIN else None


def explain_timing(capture: Capture, sights: list[Sight]) -> Verdict | None:
    """Another relation between pictures and motion frames that fits better, or None."""
    candidates: list[tuple[str, Callable[[int], int]]] = []
    for shift in SHIFTS:
        when = f"{abs(shift)} frame{'s' * (abs(shift) > 1)} {'late' if shift > 0 else 'early'}"
        candidates.append((f"the motion looks {when}: picture k shows motion frame k{shift:+d}", shift.__add__))
    for rate in STRIDES:
        sentence = f"the motion looks sampled at {rate:.3g} times the rate of the pictures"
        candidates.append((sentence, lambda k, rate=rate: round(rate * k)))  # type: ignore[misc]
    best, gain = Verdict("", 0.0), TIME_GAIN
    for sentence, index in candidates:
        pairs = [(seen, index(seen.frame.frame)) for seen in sights]
        pairs = [(s, k) for s, k in pairs if k != s.frame.frame and 0 <= k < capture.motion.frame_count]
        if len(pairs) < min(4, len(sights)):
            continue
        here = mean_overlap([seen for seen, _ in pairs])
        there = mean_overlap([posed(capture, seen, k) for seen, k in pairs])
        if there - here > gain:
            best, gain = Verdict(sentence, there), there - here
    return best if best.sentence else None
