"""Posed joints and points of a skeleton, and their derivatives.

A pose's unknowns are one rotation δ_k (rad, right-multiplied: R_k ← R_k exp(δ_k)) per joint and the root's shift (m):
[3J + 3] numbers a frame, joints first. Derivatives are taken at δ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.skeleton import Skeleton, chain

Floats = NDArray[np.float64]


def descendants(parents: NDArray[np.int32]) -> Floats:
    """[J, J], 1 where the column's joint moves the row's: itself or an ancestor of it."""
    moved = np.eye(len(parents))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            moved[joint] += moved[parent]
    return moved


@dataclass(frozen=True, eq=False)
class Posed:
    """T posed skeletons.

    Attributes:
        rotations: [T, J, 3, 3] local, translations: [T, 3] m, rest: [J, 3] m.
        world: [T, J, 3, 3] rotations from the rest pose into the world; joints: [T, J, 3] m.
    """

    skeleton: Skeleton
    rotations: Floats
    translations: Floats
    rest: Floats
    world: Floats
    joints: Floats

    def __len__(self) -> int:
        return len(self.translations)

    def part(self, frames: slice) -> Posed:
        """Some of the frames."""
        arrays = (self.rotations[frames], self.translations[frames])
        return Posed(self.skeleton, *arrays, self.rest, self.world[frames], self.joints[frames])


def pose(skeleton: Skeleton, rotations: Floats, translations: Floats, rest: Floats) -> Posed:
    """Pose ``skeleton`` with its joints at rest at ``rest`` [J, 3] m."""
    transforms = chain(
        np.ascontiguousarray(rotations),
        np.ascontiguousarray(translations),
        skeleton.parents,
        np.ascontiguousarray(rest),
    )
    return Posed(skeleton, rotations, translations, rest, transforms[:, :, :3, :3], transforms[:, :, :3, 3])


def step(rotations: Floats, translations: Floats, delta: Floats, active: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """The pose after ``delta`` [T, 3A + 3] of the joints ``active`` [A] and the root's position."""
    moved = rotations.copy()
    turns = axis_angle_to_matrix(delta[:, :-3].reshape(len(delta), -1, 3))
    moved[:, active] = rotations[:, active] @ turns
    return moved, translations + delta[:, -3:]


def attached(posed: Posed, joints: NDArray[np.int64], places: Floats) -> Floats:
    """World positions [T, P, 3] of points fixed to ``joints`` [P], at rest at ``places`` [P, 3] m."""
    lever = places - posed.rest[joints]
    return posed.joints[:, joints] + np.einsum("tpij,pj->tpi", posed.world[:, joints], lever)


def point_derivative(posed: Posed, points: Floats, joints: NDArray[np.int64], active: NDArray[np.int64]) -> Floats:
    """d points / d unknowns [T, P, 3, 3A + 3] of ``points`` [T, P, 3] that are fixed to ``joints`` [P]."""
    moved = descendants(posed.skeleton.parents)[joints][:, active]
    return _by_levers(posed, points[:, :, None] * moved[None, :, :, None], moved[None], active)


def skinned_derivative(
    posed: Posed, parts: Floats, weights: Floats, joints: NDArray[np.int64], active: NDArray[np.int64]
) -> Floats:
    """``point_derivative`` of skinned points: ``parts`` [T, P, B, 3] by each of B bones ``joints`` [T, P, B],
    ``weights`` [T, P, B]."""
    moved = descendants(posed.skeleton.parents)[:, active][joints]  # [T, P, B, A]
    share = moved * weights[..., None]
    return _by_levers(posed, np.einsum("tpba,tpbi->tpai", share, parts), share.sum(2), active)


def _by_levers(posed: Posed, moments: Floats, share: Floats, active: NDArray[np.int64]) -> Floats:
    """Derivative from Σ w x [T, P, A, 3] and Σ w [T or 1, P, A] of the bones that each joint moves."""
    levers = moments - share[..., None] * posed.joints[:, None, active]  # [T, P, A, 3]
    axes = np.swapaxes(posed.world[:, active], -1, -2)  # [T, A, 3 (axis), 3]
    turned = np.cross(axes[:, None], levers[:, :, :, None, :])  # [T, P, A, 3 (axis), 3]
    frames, count = levers.shape[:2]
    result = np.zeros((frames, count, 3, 3 * len(active) + 3))
    result[..., :-3] = np.moveaxis(turned, -1, 2).reshape(frames, count, 3, -1)
    result[..., -3:] = np.eye(3)
    return result


def direction_derivative(
    posed: Posed, directions: Floats, joints: NDArray[np.int64], active: NDArray[np.int64]
) -> Floats:
    """d directions / d unknowns [T, P, 3, 3A + 3] of ``directions`` [T, P, 3] that rotate with ``joints`` [P]."""
    moved = descendants(posed.skeleton.parents)[joints][:, active]  # [P, A]
    axes = np.swapaxes(posed.world[:, active], -1, -2)
    turned = np.cross(axes[:, None], directions[:, :, None, None, :]) * moved[None, :, :, None, None]
    frames, count = directions.shape[:2]
    result = np.zeros((frames, count, 3, 3 * len(active) + 3))
    result[..., :-3] = np.moveaxis(turned, -1, 2).reshape(frames, count, 3, -1)
    return result


def shape_derivative(posed: Posed, joint_basis: Floats) -> Floats:
    """d joints / d shape [T, J, 3, K] of ``joint_basis`` [K, J, 3]: rest joints per unit of each of K parameters."""
    basis = np.moveaxis(joint_basis, 0, -1)  # [J, 3, K]
    result = np.empty((len(posed), *basis.shape))
    for joint, parent in enumerate(posed.skeleton.parents):
        if parent < 0:
            result[:, joint] = basis[joint]
        else:
            result[:, joint] = result[:, parent] + posed.world[:, parent] @ (basis[joint] - basis[parent])
    return result
