"""Where BlazePose's points and the knuckles of hand networks are on a body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.observations import FINGERS, LANDMARKS, TRUNK

from .figure import Figure

Floats = NDArray[np.float64]

KNUCKLES = (5, 9, 13, 17)
"""points of a hand network that are fixed to the hand: bases of index, middle, ring and little finger"""
JOINT_MARKS = {11: "shoulder", 13: "elbow", 15: "wrist", 23: "hip", 25: "knee", 27: "ankle"}  # right ones are one more
# m from the wrist of the left arm in the T-pose; the body's hand is 1 from wrist to middle knuckle
_ON_HAND = {19: (1.0, 0, 0.24), 17: (0.85, 0, -0.34), 21: (0.60, -0.10, 0.52)}
_KNUCKLES_ON_HAND = ((1.0, 0, 0.24), (1.02, 0, 0.0), (0.96, 0, -0.20), (0.85, 0, -0.34))
_MIDDLE_KNUCKLE_M = 0.092
HAND_MARKS = LANDMARKS
"""number of the first knuckle among ``Marks``: 4 of the left hand, then 4 of the right"""


@dataclass(frozen=True, eq=False)
class Marks:
    """P points fixed to joints: BlazePose's 33, then four knuckles of each hand.

    Attributes:
        joints: [P] they are fixed to.
        places: [P, 3] m at rest, β = 0; basis: [K, P, 3] m per unit of shape.
        mirror: [P] each point's counterpart on the other side; itself in the middle.
        freedom_m: [P] deviation of the network's idea of the point from this place, m.
    """

    joints: NDArray[np.int64]
    places: Floats
    basis: Floats
    mirror: NDArray[np.int64]
    freedom_m: Floats


def marks_of(figure: Figure) -> Marks:
    """The points on ``figure``, found from its joints and its surface."""
    body, skeleton = figure.body, figure.body.skeleton
    index = {name: k for k, name in enumerate(skeleton.names)}
    rest = skeleton.rest_joints
    count = HAND_MARKS + 8
    joints, places = np.zeros(count, np.int64), np.zeros((count, 3))
    basis, freedom = np.zeros((len(figure.names), count, 3)), np.full(count, 0.012)
    mirror = np.arange(count)

    def on_joint(mark: int, joint: str, offset: Floats | tuple[float, ...] = (0, 0, 0)) -> None:
        k = index[joint]
        joints[mark], places[mark], basis[:, mark] = k, rest[k] + offset, figure.joint_basis[:, k]

    def on_surface(mark: int, joint: str, place: Floats) -> None:
        vertex = int(((body.vertices - place) ** 2).sum(1).argmin())
        joints[mark], places[mark] = index[joint], place
        basis[:, mark] = figure.vertex_basis[:, vertex]

    owner = body.skinning_weights.argmax(1)
    _face(body.vertices[owner == index["head"]], on_surface)
    mirror[list(range(1, 7))] = [4, 5, 6, 1, 2, 3]
    for side, right in (("left_", 0), ("right_", 1)):
        sign = 1 - 2 * right
        for mark, name in JOINT_MARKS.items():
            on_joint(mark + right, side + name)
        wrist, size = side + "wrist", _MIDDLE_KNUCKLE_M
        for mark, place in _ON_HAND.items():
            on_joint(mark + right, wrist, np.array(place) * (sign * size, size, size))
        for k, place in enumerate(_KNUCKLES_ON_HAND):
            on_joint(HAND_MARKS + 4 * right + k, wrist, np.array(place) * (sign * size, size, size))
        foot = body.vertices[(owner == index[side + "ankle"]) | (owner == index[side + "foot"])]
        sole = foot[foot[:, 1] < foot[:, 1].min() + 0.05]
        on_surface(29 + right, side + "ankle", sole[sole[:, 2].argmin()] + (0, 0.01, 0.01))
        on_surface(31 + right, side + "foot", sole[sole[:, 2].argmax()] + (0, 0.01, -0.02))
    for left in (7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31):
        mirror[[left, left + 1]] = left + 1, left
    mirror[HAND_MARKS:] = HAND_MARKS + np.array([4, 5, 6, 7, 0, 1, 2, 3])
    freedom[TRUNK] = 0.03
    freedom[FINGERS] = freedom[HAND_MARKS:] = 0.015
    return Marks(joints, places, basis, mirror, freedom)


def _face(head: Floats, on_surface) -> None:
    """Nose, eyes, ears and mouth of the head's vertices [N, 3]."""
    nose = head[head[:, 2].argmax()]
    middle, depth = nose[0], np.median(head[:, 2])
    on_surface(0, "head", nose)
    band = head[(np.abs(head[:, 1] - nose[1] - 0.02) < 0.03) & (np.abs(head[:, 2] - depth) < 0.04)]
    for sign, (inner, eye, outer, ear, mouth) in ((1, (1, 2, 3, 7, 9)), (-1, (4, 5, 6, 8, 10))):
        on_surface(ear, "head", band[(sign * band[:, 0]).argmax()])
        for mark, across in ((inner, 0.018), (eye, 0.032), (outer, 0.045)):
            on_surface(mark, "head", np.array([middle + sign * across, nose[1] + 0.035, nose[2] - 0.03]))
        on_surface(mouth, "head", np.array([middle + sign * 0.025, nose[1] - 0.04, nose[2] - 0.015]))
