"""The stretch of motion an avatar's skinning looks at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .interpolation import steps
from .motion import Motion
from .rotations import rotation_6d

Floats32 = NDArray[np.float32]


def motion_window(motion: Motion, time_s: float, *, poses: int, seconds: float) -> tuple[Floats32, Floats32]:
    """The last ``poses`` poses before and at ``time_s``, evenly spaced over ``seconds``, without the root.

    The window is in seconds, so a motion at 120 frames per second and its copy at 30 give the same window.
    The root is left out, so turning or moving the avatar changes nothing. Before the motion starts its first
    pose is held.

    Returns:
        pose_window: [poses, J − 1, 6], :func:`rotations.rotation_6d` of the local rotations, oldest first.
        joint_velocity: [J − 1, 3] rad/s, ``log(R_{t−δ}ᵀ R_t) / δ`` with δ the spacing of the window
            (``seconds`` itself when ``poses`` is 1): continuous where axis-angles jump at π.
    """
    return described(recent_poses(motion, time_s, poses=poses, seconds=seconds), poses=poses, seconds=seconds)


def recent_poses(motion: Motion, time_s: float, *, poses: int, seconds: float) -> Motion:
    """The poses that :func:`motion_window` describes, the one at ``time_s`` last; two where ``poses`` is 1."""
    assert poses >= 1 and seconds > 0, (poses, seconds)
    count = max(poses, 2)
    return motion.at(time_s - _spacing(poses, seconds) * np.arange(count - 1, -1, -1))


def described(recent: Motion, *, poses: int, seconds: float) -> tuple[Floats32, Floats32]:
    """What :func:`motion_window` returns, of :func:`recent_poses`."""
    rotations = recent.rotations[:, 1:]
    velocity = steps(rotations[-2], rotations[-1]) / _spacing(poses, seconds)
    return rotation_6d(rotations[-poses:]).astype(np.float32), velocity.astype(np.float32)


def _spacing(poses: int, seconds: float) -> float:
    return seconds / max(poses - 1, 1)
