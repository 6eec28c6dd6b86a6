"""Body poses of a data set, in the root conventions of SMPL and EasyMocap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import NAMES_BY_COUNT, SMPL_NAMES

Floats = NDArray[np.float64]
BodyFit = Callable[[Skeleton], tuple[Floats, Floats]]
RootConvention = Literal["smpl", "easymocap", "position"]


@dataclass(frozen=True, eq=False)
class Poses:
    """Body poses in the source's world."""

    frames: NDArray[np.int64]  # [F] frame numbers, strictly ascending
    rotations: Floats  # [F, J, 3, 3] local, the root first
    root: Callable[[Floats], Floats]  # root positions [F, 3] m for the root's rest position [3] m
    joint_names: tuple[str, ...] = SMPL_NAMES  # J
    family: str = "SMPL"  # or "SMPL-X": whose rest pelvis ``root`` takes
    betas: Floats | None = None  # shape
    convention: RootConvention = "position"  # "smpl": rest + trans, "easymocap": R rest + Th, "position": as stored
    # of poses on another skeleton: rotations [F, J, 3, 3] and root positions [F, 3] of a body's own
    fit: BodyFit | None = None
    named: bool = False  # the file names its joints: to a body of the same, ``root`` takes that body's own pelvis

    def __post_init__(self) -> None:
        count = len(self.frames)
        if count == 0:
            raise InputError("body poses", expected="at least one frame", got="none")
        late = np.flatnonzero(np.diff(self.frames) <= 0)
        if len(late):
            before, after = self.frames[late[0] : late[0] + 2].tolist()
            raise InputError("body poses", expected="frames that ascend", got=f"{after} after {before}")
        if self.rotations.shape != (count, len(self.joint_names), 3, 3):
            expected = f"{count} × {len(self.joint_names)} rotations"
            raise InputError("body poses", expected=expected, got=list(self.rotations.shape))
        positions = self.root(np.zeros(3))
        if positions.shape != (count, 3):
            raise InputError("positions of the root", expected=f"{count} × 3", got=_shape(positions))
        finite = np.isfinite(self.rotations).all((1, 2, 3)) & np.isfinite(positions).all(1)
        if not finite.all():
            raise InputError("body poses", expected="finite numbers", frame=int(self.frames[~finite][0]))


@dataclass(frozen=True, eq=False)
class PoseFile:
    """Content of a file of body poses."""

    kind: str  # the program that wrote it
    poses: Poses  # in camera axes if ``in_camera``, otherwise in the world
    K: Floats | None = None  # [3, 3] intrinsics
    focal: Callable[[int, int], float] | None = None  # the program's assumed focal length in px of width and height
    fps: float | None = None
    notes: tuple[str, ...] = ()  # assumptions, one sentence each
    numbered: bool = False  # one file per frame, numbered by name; otherwise frames count from 0
    in_camera: bool = False


def smpl_poses(
    frames: Sequence[int] | NDArray[np.int64],
    axis_angles: ArrayLike,
    trans: ArrayLike,
    betas: ArrayLike | None = None,
    *,
    family: str = "SMPL",
    member: str = "trans",
    joint_names: tuple[str, ...] | None = None,
) -> Poses:
    """Poses in SMPL's convention: the root rotates about its rest position J0, its position is J0 + trans.

    Args:
        axis_angles: [F, 3J] or [F, J, 3] rad, the root first.
        trans: [F, 3] m.
        member: name of ``trans`` in the file.
        joint_names: J. Default: the family's order for 22, 24, 52 or 55 joints.
    """
    rotations, names = _rotations(axis_angles, joint_names)
    offsets = rows_of_three(member, trans, len(rotations))
    return Poses(
        np.asarray(frames, np.int64),
        rotations,
        lambda rest: rest + offsets,
        names,
        family,
        mean_betas(betas),
        "smpl",
        named=joint_names is not None,
    )


def easymocap_poses(
    frames: Sequence[int] | NDArray[np.int64],
    axis_angles: ArrayLike,
    Rh: ArrayLike,
    Th: ArrayLike,
    betas: ArrayLike | None = None,
    *,
    family: str = "SMPL",
    members: tuple[str, str] = ("Rh", "Th"),
    joint_names: tuple[str, ...] | None = None,
) -> Poses:
    """Poses in EasyMocap's convention: x = R(Rh) X + Th about the origin, for a body X with an unrotated root.

    A root rotation in ``axis_angles`` is applied about the pelvis first. ``members`` are the names of ``Rh`` and
    ``Th`` in the file; other arguments as in ``smpl_poses``.
    """
    rotations, names = _rotations(axis_angles, joint_names)
    root = axis_angle_to_matrix(rows_of_three(members[0], Rh, len(rotations)))
    offsets = rows_of_three(members[1], Th, len(rotations))
    rotations[:, 0] = root @ rotations[:, 0]
    frames, betas = np.asarray(frames, np.int64), mean_betas(betas)
    return Poses(frames, rotations, lambda rest: root @ rest + offsets, names, family, betas, "easymocap")


def with_convention(poses: Poses, convention: RootConvention) -> Poses:
    """``poses`` reinterpreted in another root convention.

    Raises:
        InputError: the layout stores root positions.
    """
    if convention == poses.convention:
        return poses
    if poses.convention == "position":
        raise InputError("--root", expected="none, as this layout stores the pelvis position", got=convention)
    offsets, rotation = poses.root(np.zeros(3)), poses.rotations[:, 0]

    def root(rest: Floats) -> Floats:
        return offsets + (rotation @ rest if convention == "easymocap" else rest)

    return replace(poses, root=root, convention=convention)


def transformed(poses: Poses, motion: Floats) -> Poses:
    """``poses`` in another world, by the rigid transform ``motion`` [4, 4]."""
    rotation, shift = motion[:3, :3], motion[:3, 3]

    def rotated(rotations: Floats) -> Floats:
        rotations = rotations.copy()
        rotations[:, 0] = rotation @ rotations[:, 0]
        return rotations

    def fit(skeleton: Skeleton) -> tuple[Floats, Floats]:
        assert poses.fit is not None
        rotations, positions = poses.fit(skeleton)
        return rotated(rotations), positions @ rotation.T + shift

    return replace(
        poses,
        rotations=rotated(poses.rotations),
        root=lambda rest: poses.root(rest) @ rotation.T + shift,
        fit=None if poses.fit is None else fit,
    )


def on_body(poses: Poses, skeleton: Skeleton, family: str) -> Poses:
    """``poses`` with the rotations of a body's ``skeleton``, where they were recorded on another."""
    if poses.fit is None:
        return poses
    rotations, positions = poses.fit(skeleton)
    names = skeleton.names
    return replace(poses, rotations=rotations, root=lambda rest: positions, joint_names=names, family=family, fit=None)


def rows_of_three(name: str, values: ArrayLike, count: int) -> Floats:
    """``values`` as [count, 3]; ``InputError`` naming ``name`` for another count."""
    array = np.asarray(values, np.float64)
    if array.size != 3 * count:
        raise InputError(name, expected=f"{count} × 3, as there are {count} poses", got=_shape(array))
    return array.reshape(count, 3)


def mean_betas(betas: ArrayLike | None) -> Floats | None:
    """Mean shape [B] of [B] or [F, B]."""
    if betas is None:
        return None
    array = np.atleast_1d(np.asarray(betas, np.float64))
    return array.reshape(-1, array.shape[-1]).mean(0)


def _rotations(axis_angles: ArrayLike, names: tuple[str, ...] | None) -> tuple[Floats, tuple[str, ...]]:
    angles = np.asarray(axis_angles, np.float64)
    if not angles.size:
        raise InputError("body poses", expected="at least one frame", got="none")
    joints, rest = divmod(angles.size, 3 * len(angles))
    names = names or NAMES_BY_COUNT.get(joints)
    if rest or names is None:
        known = ", ".join(map(str, NAMES_BY_COUNT))
        raise InputError("joints of the body poses", expected=known, got=_shape(angles) if rest else joints)
    return axis_angle_to_matrix(angles.reshape(-1, joints, 3)), names


def _shape(array: Floats) -> str:
    return " × ".join(map(str, array.shape)) or "a single number"
