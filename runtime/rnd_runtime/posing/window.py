"""An avatar's input at one moment: a window of recent poses, and bones."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.interpolation import interpolate_points, interpolate_rotations, step_between
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton, bones_of, chain

from .forearm import forearms, rotate_forearm, share

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


class Moment(NamedTuple):
    """A moment of a motion, in the root's frame.

    The window holds the last poses, evenly spaced in seconds, without the root. It depends on neither frame rate nor
    the body's position and heading.
    """

    window: Floats32  # [poses, J − 1, 6] rotation_6d of the local rotations, oldest first
    velocity: Floats32  # [J − 1, 3] rad/s, log(R_{t−δ}ᵀ R_t) / δ
    bones: Floats32  # [J, 3, 4] m, rest pose → root frame; forearm twists are shared
    root: Floats  # [4, 4] m, root frame → world


def moment(motion: Motion, time_s: float, skeleton: Skeleton, *, poses: int, seconds: float) -> Moment:
    """``motion`` (of ``skeleton``) at ``time_s``.

    δ is the window's spacing, ``seconds`` where ``poses`` is 1. Before its start a motion keeps its first pose.

    Raises:
        InputError: the motion has other joints than the skeleton; ``motion.motion.load_motion`` maps them.
    """
    joints = motion.rotations.shape[1]
    if joints != len(skeleton):
        raise InputError("joints of the motion", expected=len(skeleton), got=joints)
    return Moment(*_moment(*_recent(motion, time_s, poses, seconds), poses, _tree(skeleton)))


def motion_window(motion: Motion, time_s: float, *, poses: int, seconds: float) -> tuple[Floats32, Floats32]:
    """``window`` and ``velocity`` of the ``moment``."""
    (rotations, _, position), spacing = _recent(motion, time_s, poses, seconds)
    window, velocity = _window(interpolate_rotations(rotations, position), spacing, poses)
    return window, velocity


def _recent(motion: Motion, time_s: float, poses: int, seconds: float) -> tuple[tuple[Floats, Floats, Floats], float]:
    """``Motion.path_at`` of the last ``poses`` poses (at least two), and their spacing in s."""
    assert poses >= 1 and seconds > 0, (poses, seconds)
    spacing, count = seconds / max(poses - 1, 1), max(poses, 2)
    return motion.path_at(time_s - spacing * np.arange(count - 1, -1, -1)), spacing


class _Tree(NamedTuple):
    parents: NDArray[np.int32]  # [J]
    rest_joints: Floats  # [J, 3] m
    ends: NDArray[np.int64]  # [A, 2] elbow and wrist of each forearm
    axes: Floats  # [A, 3] unit


@lru_cache(maxsize=16)
def _tree(skeleton: Skeleton) -> _Tree:
    arms = forearms(skeleton)
    return _Tree(
        skeleton.parents,
        np.ascontiguousarray(skeleton.rest_joints),
        np.array([arm[:2] for arm in arms], np.int64).reshape(-1, 2),
        np.array([arm[2] for arm in arms], np.float64).reshape(-1, 3),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _moment(path, spacing, poses, tree):  # type: ignore[no-untyped-def]
    """``moment`` compiled: numpy takes 0.4 ms per frame."""
    rotations, translations, position = path
    recent, positions = interpolate_rotations(rotations, position), interpolate_points(translations, position)
    window, velocity = _window(recent, spacing, poses)
    root = np.zeros((4, 4))
    bones = _bones(recent[-1], positions[-1], tree, root)
    return window, velocity, bones, root


@njit(nogil=True, cache=True, error_model="numpy")
def _window(recent, spacing, poses):  # type: ignore[no-untyped-def]
    joints, first = recent.shape[1], len(recent) - poses
    window, velocity = np.empty((poses, joints - 1, 6), np.float32), np.empty((joints - 1, 3), np.float32)
    step = np.empty(3)
    for joint in range(joints - 1):
        for pose in range(poses):
            for k in range(3):
                window[pose, joint, k] = recent[first + pose, joint + 1, k, 0]
                window[pose, joint, 3 + k] = recent[first + pose, joint + 1, k, 1]
        step_between(recent[-2, joint + 1], recent[-1, joint + 1], step)
        for k in range(3):
            velocity[joint, k] = step[k] / spacing
    return window, velocity


@njit(error_model="numpy")
def _bones(rotations, translation, tree, root):  # type: ignore[no-untyped-def]
    """Bones of a pose [J, 3, 3] (modified in place) and its translation [3]; fills ``root``."""
    position = tree.rest_joints[0]
    root[3, 3] = 1.0
    for row in range(3):
        root[row, 3] = position[row] + translation[row]
        for k in range(3):
            root[row, k] = rotations[0, row, k]
            root[row, 3] -= rotations[0, row, k] * position[k]
            rotations[0, row, k] = 1.0 if row == k else 0.0
    for arm in range(len(tree.ends)):
        elbow, wrist, axis = tree.ends[arm, 0], tree.ends[arm, 1], tree.axes[arm]
        angle = share(rotations, elbow, wrist, axis)
        if angle != 0.0:
            rotate_forearm(rotations, elbow, wrist, axis, angle)
    posed = chain(np.expand_dims(rotations, 0), np.zeros((1, 3)), tree.parents, tree.rest_joints)
    return bones_of(posed, tree.rest_joints)[0]
