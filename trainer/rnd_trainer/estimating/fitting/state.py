"""The unknowns of a fit: a pose a frame, and what all frames share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .figure import JOINTS, Figure
from .kinematics import Posed, pose, step
from .marks import Marks

Floats = NDArray[np.float64]

TO_CAMERA = np.diag([1.0, -1.0, -1.0])
"""the fit's world is the camera's with Y up and Z towards it"""


@dataclass(frozen=True, eq=False)
class State:
    """Poses [T, J, 3, 3], [T, 3] m; shape [K]; offsets [P, 3] m of the marks; log focal length; ground.

    ``ground`` is (height of the plane's point over the camera's foot, m, and its normal's x and z over y).
    """

    rotations: Floats
    translations: Floats
    shape: Floats
    offsets: Floats
    log_focal: float
    ground: Floats

    @property
    def focal(self) -> float:
        return float(np.exp(self.log_focal))

    @property
    def up(self) -> Floats:
        normal = np.array([self.ground[1], 1.0, self.ground[2]])
        return normal / np.linalg.norm(normal)

    def posed(self, figure: Figure) -> Posed:
        skeleton = figure.body.skeleton
        rest = skeleton.rest_joints + np.tensordot(self.shape, figure.joint_basis, 1)
        return pose(skeleton, self.rotations, self.translations, rest)


class Layout:
    """Positions of the unknowns: [3A + 3] of a frame; shape, offsets, focal length and ground of all frames."""

    def __init__(self, figure: Figure, marks: Marks) -> None:
        names = figure.body.skeleton.names
        self.active = np.array(sorted(names.index(name) for name in JOINTS))
        self.unknowns = 3 * len(self.active) + 3
        self.free = np.flatnonzero(marks.mirror >= np.arange(len(marks.mirror)))  # marks with an offset of their own
        self.source = np.searchsorted(self.free, np.minimum(marks.mirror, np.arange(len(marks.mirror))))
        self.mirrored = marks.mirror < np.arange(len(marks.mirror))
        shape, offsets = len(figure.names), 3 * len(self.free)
        self.shape = slice(0, shape)
        self.offsets = slice(shape, shape + offsets)
        self.focal = shape + offsets
        self.ground = slice(self.focal + 1, self.focal + 4)
        self.shared = self.focal + 4

    def offset_derivative(self) -> Floats:
        """d offsets [P, 3] / d free offsets [P, 3, 3F]: right marks mirror the left ones."""
        count = len(self.source)
        result = np.zeros((count, 3, len(self.free), 3))
        sign = np.where(self.mirrored, -1.0, 1.0)
        for axis in range(3):
            result[np.arange(count), axis, self.source, axis] = sign if axis == 0 else 1.0
        return result.reshape(count, 3, -1)

    def moved(self, state: State, local: Floats, shared: Floats) -> State:
        """``state`` after a step [T, 3A + 3], [G]."""
        rotations, translations = step(state.rotations, state.translations, local, self.active)
        return replace(
            state,
            rotations=rotations,
            translations=translations,
            shape=state.shape + shared[self.shape],
            offsets=state.offsets + self.offset_derivative() @ shared[self.offsets],
            log_focal=state.log_focal + float(shared[self.focal]),
            ground=state.ground + shared[self.ground],
        )
