"""A motion as AMASS' SMPL-H .npz, which Blender's SMPL add-on, aitviewer and most trainers read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.core.npz import save_npz
from rnd_runtime.core.rotations import matrix_to_axis_angle

from .motion import STAND_INS, Z_UP_TO_Y_UP, Motion
from .skeleton import Skeleton, moving_joints
from .smpl import SMPL_REST_ROOT, SMPLH_NAMES

# SMPL-H's finger bases, which SMPL's single joint per hand drives
FINGER_BASES = ("index1", "middle1", "pinky1", "ring1", "thumb1")


def write_amass(path: Path, motion: Motion, skeleton: Skeleton) -> tuple[str, ...]:
    """Write ``motion`` of ``skeleton``; return the moving joints that SMPL-H lacks, which are left out.

    ``poses`` [F, 156] axis-angle rad, ``trans`` [F, 3] m for SMPL-H's mean body, ``betas`` [16] zero, ``gender``
    neutral, ``mocap_framerate``; Z up. The pelvis keeps its position.
    """
    axis_angles = matrix_to_axis_angle(motion.rotations)
    columns = {name: k for k, name in enumerate(SMPLH_NAMES)}
    poses = np.zeros((motion.frame_count, len(SMPLH_NAMES), 3))
    moving = {name for name, moves in zip(motion.joint_names, moving_joints(motion.rotations)) if moves}
    sides_with_fingers = {name.split("_")[0] for name in moving.intersection(SMPLH_NAMES[22:])}
    lost = []
    for joint, name in enumerate(motion.joint_names):
        side = name.removesuffix("_hand")
        if joint == 0:
            poses[:, 0] = matrix_to_axis_angle(Z_UP_TO_Y_UP.T @ motion.rotations[:, 0])
        elif name in columns:
            poses[:, columns[name]] = axis_angles[:, joint]
        elif side in {"left", "right"} - sides_with_fingers:
            for base in FINGER_BASES:
                poses[:, columns[f"{side}_{base}"]] = axis_angles[:, joint]
        elif name in moving and not _stands_in(name, motion):
            lost.append(name)
    pelvis = (skeleton.rest_joints[0] + motion.translations) @ Z_UP_TO_Y_UP
    save_npz(
        path,
        {
            "poses": poses.reshape(motion.frame_count, -1),
            "trans": pelvis - SMPL_REST_ROOT,
            "betas": np.zeros(16),
            "dmpls": np.zeros((motion.frame_count, 8)),
            "gender": np.array("neutral"),
            "mocap_framerate": np.array(motion.fps),
        },
    )
    return tuple(lost)


def _stands_in(name: str, motion: Motion) -> bool:
    """Whether joint ``name`` is a hand that repeats the index finger's base (``motion.STAND_INS``)."""
    finger = STAND_INS.get(name)
    if finger not in motion.joint_names:
        return False
    hand, base = (motion.rotations[:, motion.joint_names.index(joint)] for joint in (name, finger))
    return np.array_equal(hand, base)
