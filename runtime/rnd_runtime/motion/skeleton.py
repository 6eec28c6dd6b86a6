"""Joint trees and their posing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.errors import InputError

from .smpl import SMPL_NAMES, SMPL_PARENTS

Floats = NDArray[np.float64]

_TURNS = 1e-6  # min change of a matrix element of a moving joint


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A joint tree in its rest pose.

    Attributes:
        names: J unique joint names, the root first.
        parents: [J] parent indices, −1 for the root; parents come first.
        rest_joints: [J, 3] m, joint positions in the rest pose.

    Raises:
        InputError: the arrays are not one tree rooted at joint 0.
    """

    names: tuple[str, ...]
    parents: NDArray[np.int32]
    rest_joints: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(str(name) for name in self.names))
        parents = np.asarray(self.parents)  # not cast yet, which could overflow
        object.__setattr__(self, "rest_joints", np.asarray(self.rest_joints, np.float64))
        count = len(self.names)
        if count == 0 or parents.shape != (count,) or self.rest_joints.shape != (count, 3):
            raise InputError(
                "skeleton",
                expected=f"parents [{count}] and rest joints [{count}, 3] for {count} names, at least one",
                got=f"{list(parents.shape)} and {list(self.rest_joints.shape)}",
            )
        if len(set(self.names)) != count:
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise InputError("skeleton joint names", expected="each name once", got=", ".join(twice))
        earlier = (parents >= 0) & (parents < np.arange(count)) & (parents == np.floor(parents))
        if parents[0] != -1 or not earlier[1:].all():
            raise InputError(
                "skeleton parents",
                expected="-1 first, then for every joint the index of an earlier one",
                got=parents.tolist(),
            )
        object.__setattr__(self, "parents", parents.astype(np.int32))
        if not np.isfinite(self.rest_joints).all():
            raise InputError("skeleton rest joints", expected="finite metres")

    def __len__(self) -> int:
        return len(self.names)

    def joint_transforms(self, rotations: ArrayLike, translation: ArrayLike) -> Floats:
        """World transforms ``G`` [..., J, 4, 4] of the posed joints.

        ``G_k = G_parent(k) · [R_k | rest_k − rest_parent]``; the root rotates about its rest position, then translates.

        Args:
            rotations: [..., J, 3, 3] local rotations relative to the rest pose.
            translation: [..., 3] m.
        """
        rotations, translation = np.asarray(rotations, np.float64), np.asarray(translation, np.float64)
        count = len(self)
        if rotations.shape[-3:] != (count, 3, 3) or translation.shape[-1:] != (3,):
            raise InputError(
                "pose",
                expected=f"rotations [..., {count}, 3, 3] and a translation [..., 3]",
                got=f"{list(rotations.shape)} and {list(translation.shape)}",
            )
        batch = np.broadcast_shapes(rotations.shape[:-3], translation.shape[:-1])
        posed: Floats = chain(
            np.ascontiguousarray(np.broadcast_to(rotations, (*batch, count, 3, 3))).reshape(-1, count, 3, 3),
            np.ascontiguousarray(np.broadcast_to(translation, (*batch, 3))).reshape(-1, 3),
            self.parents,
            self.rest_joints,
        )
        return posed.reshape(*batch, count, 4, 4)


def moving_joints(rotations: Floats) -> NDArray[np.bool_]:
    """Joints [J] of ``rotations`` [F, J, 3, 3] that ever leave the identity."""
    moving: NDArray[np.bool_] = np.abs(rotations - np.eye(3)).max((0, 2, 3)) > _TURNS
    return moving


def smpl_skeleton(rest_joints: ArrayLike) -> Skeleton:
    """SMPL's tree with joints at ``rest_joints`` [24, 3] m."""
    return Skeleton(SMPL_NAMES, np.array(SMPL_PARENTS, np.int32), np.asarray(rest_joints, np.float64))


def bone_transforms(skeleton: Skeleton, rotations: ArrayLike, translation: ArrayLike) -> NDArray[np.float32]:
    """Transforms of rest-pose points by each bone: ``G(pose) · G(rest)⁻¹`` as [..., J, 3, 4] float32.

    Args:
        skeleton: J joints.
        rotations: [..., J, 3, 3] local rotations of the pose.
        translation: [..., 3] m.
    """
    posed = skeleton.joint_transforms(rotations, translation)
    bones: NDArray[np.float32] = bones_of(posed.reshape(-1, *posed.shape[-3:]), skeleton.rest_joints)
    return bones.reshape(*posed.shape[:-2], 3, 4)


def taken_along(bones: ArrayLike, motion: Floats) -> NDArray[np.float32]:
    """Bones [J, 3, 4] m followed by ``motion`` [4, 4] (rigid, m)."""
    moved = np.asarray(motion[:3, :3] @ np.asarray(bones, np.float64))
    moved[:, :, 3] += motion[:3, 3]
    return moved.astype(np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def bones_of(posed, rest_joints):  # type: ignore[no-untyped-def]
    """``bone_transforms`` [B, J, 3, 4] float32 of world transforms [B, J, 4, 4]."""
    bones = np.empty((*posed.shape[:2], 3, 4), np.float32)
    for pose in range(posed.shape[0]):
        for joint in range(posed.shape[1]):
            for row in range(3):
                at_rest = 0.0
                for k in range(3):
                    bones[pose, joint, row, k] = posed[pose, joint, row, k]
                    at_rest += posed[pose, joint, row, k] * rest_joints[joint, k]
                bones[pose, joint, row, 3] = posed[pose, joint, row, 3] - at_rest
    return bones


@njit(nogil=True, cache=True, error_model="numpy")
def chain(rotations, translations, parents, rest_joints):  # type: ignore[no-untyped-def]
    """``Skeleton.joint_transforms`` [B, J, 4, 4] of rotations [B, J, 3, 3] and translations [B, 3]."""
    posed = np.zeros((*rotations.shape[:2], 4, 4))
    for pose in range(rotations.shape[0]):
        for joint in range(rotations.shape[1]):
            posed[pose, joint, 3, 3] = 1.0
        for row in range(3):
            posed[pose, 0, row, 3] = rest_joints[0, row] + translations[pose, row]
            for k in range(3):
                posed[pose, 0, row, k] = rotations[pose, 0, row, k]
        for joint in range(1, rotations.shape[1]):
            parent = posed[pose, parents[joint]]
            for row in range(3):
                position = parent[row, 3]
                for k in range(3):
                    position += parent[row, k] * (rest_joints[joint, k] - rest_joints[parents[joint], k])
                    product = 0.0
                    for inner in range(3):
                        product += parent[row, inner] * rotations[pose, joint, inner, k]
                    posed[pose, joint, row, k] = product
                posed[pose, joint, row, 3] = position
    return posed
