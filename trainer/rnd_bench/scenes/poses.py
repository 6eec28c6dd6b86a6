"""Poses as joint angles: axis-angle in radians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion

Angles = dict[str, tuple[float, float, float]]

FPS = 30.0
APART: Angles = {"left_hip": (0, 0, 0.35), "right_hip": (0, 0, -0.35)}  # legs apart: neighbours are those on the skin
ARMS_DOWN: Angles = {"left_shoulder": (0, 0, -1.0), "right_shoulder": (0, 0, 1.0)}
EXTREMES: dict[str, Angles] = {
    "T-pose": {},
    "squat": {
        **{"left_hip": (-1.9, 0, 0.2), "right_hip": (-1.9, 0, -0.2)},
        **{"left_knee": (2.2, 0, 0), "right_knee": (2.2, 0, 0), "spine1": (0.5, 0, 0)},
        **ARMS_DOWN,
    },
    "arms up": {"left_shoulder": (0, 0, 1.2), "right_shoulder": (0, 0, -1.2)},
    "splits": {"left_hip": (0, 0, 1.2), "right_hip": (0, 0, -1.2)},
}
"""unseen in an A-pose spin"""
CROSSED: Angles = {
    "left_shoulder": (0.0, -0.9, -0.8),
    "right_shoulder": (0.0, 0.9, 0.8),
    "left_elbow": (0.0, -1.7, 0.0),
    "right_elbow": (0.0, 1.7, 0.0),
}


def motion_of_poses(poses: Sequence[Angles], names: Sequence[str], fps: float = FPS) -> Motion:
    """One frame for each pose of the joints ``names``, the root at the origin."""
    angles = np.zeros((len(poses), len(names), 3))
    for frame, pose in enumerate(poses):
        for name, vector in pose.items():
            angles[frame, names.index(name)] = vector
    return Motion(axis_angle_to_matrix(angles), np.zeros((len(poses), 3)), fps, tuple(names))
