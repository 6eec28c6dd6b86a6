"""A motion as AMASS' SMPL-H .npz, which Blender's SMPL add-on, aitviewer and most trainers read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .motion import Z_UP_TO_Y_UP, Motion
from .motion_files import SMPL_REST_ROOT, SMPLH_NAMES
from .npz import save_npz
from .rotations import matrix_to_axis_angle
from .skeleton import Skeleton

# SMPL's one joint for a hand turns all its fingers; SMPL-H has their bases instead.
FINGER_BASES = ("index1", "middle1", "pinky1", "ring1", "thumb1")


def write_amass(path: Path, motion: Motion, skeleton: Skeleton) -> tuple[str, ...]:
    """Write ``motion`` of ``skeleton`` and return the joints that SMPL-H lacks and that moved, left out.

    ``poses`` [F, 156] axis-angle rad, ``trans`` [F, 3] m for SMPL-H's mean body, ``betas`` [16] zero,
    ``gender`` neutral, ``mocap_framerate``; Z up. The pelvis is where it was in ``motion``.
    """
    axis_angles = matrix_to_axis_angle(motion.rotations)
    columns = {name: k for k, name in enumerate(SMPLH_NAMES)}
    poses = np.zeros((motion.frame_count, len(SMPLH_NAMES), 3))
    lost = []
    for joint, name in enumerate(motion.joint_names):
        side = name.removesuffix("_hand")
        if joint == 0:
            poses[:, 0] = matrix_to_axis_angle(Z_UP_TO_Y_UP.T @ motion.rotations[:, 0])
        elif name in columns:
            poses[:, columns[name]] = axis_angles[:, joint]
        elif side in ("left", "right"):
            for base in FINGER_BASES:
                poses[:, columns[f"{side}_{base}"]] = axis_angles[:, joint]
        elif np.abs(axis_angles[:, joint]).max() > 1e-6:
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
