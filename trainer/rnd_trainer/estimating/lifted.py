"""What the lifter says of one person: where each bone points, how it is rotated about itself, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS

Floats32 = NDArray[np.float32]

JOINTS = SMPL_NAMES[:22]
"""names of the joints, from the pelvis to the wrists"""
PARENTS = SMPL_PARENTS[:22]

# m, from each joint's parent, in the T-pose (+X the person's left, +Y up, facing +Z): mean of the motions' bodies
REST_OFFSETS: NDArray[np.float64] = np.array(
    [
        [0, 0, 0],
        [0.086, -0.094, 0.034],  # left_hip
        [-0.086, -0.094, 0.034],
        [0, 0.084, 0.011],  # spine1
        [0, -0.417, 0],  # left_knee
        [0, -0.417, 0],
        [0, 0.106, 0.002],  # spine2
        [0, -0.419, 0],  # left_ankle
        [0, -0.419, 0],
        [0, 0.048, -0.001],  # spine3
        [0, -0.054, 0.118],  # left_foot
        [0, -0.054, 0.118],
        [0, 0.159, -0.004],  # neck
        [0.076, 0.098, -0.008],  # left_collar
        [-0.076, 0.098, -0.008],
        [0, 0.097, 0.003],  # head
        [0.114, 0.027, -0.01],  # left_shoulder
        [-0.114, 0.027, -0.01],
        [0.28, 0, 0],  # left_elbow
        [-0.28, 0, 0],
        [0.282, 0, 0],  # left_wrist
        [-0.282, 0, 0],
    ]
)
REST_DIRECTIONS: NDArray[np.float64] = REST_OFFSETS[1:] / np.linalg.norm(REST_OFFSETS[1:], axis=1, keepdims=True)
"""[21, 3] ``Lifted.directions`` of a person in the T-pose, in the body's axes"""

_LEFT, _UP, _FRONT = np.eye(3)
_ARMS = ("collar", "shoulder", "elbow", "wrist")
ROLL_AXES: NDArray[np.float64] = np.stack(
    [_FRONT if n == "head" else _UP if n.endswith(_ARMS) else _LEFT for n in JOINTS[1:]]
)
"""[21, 3] ``Lifted.roll`` of a person in the T-pose: hinge axes of knee and elbow, the direction of the face"""


@dataclass(frozen=True, eq=False)
class Lifted:
    """Bones of one person over T frames, in camera axes (x right, y down, z away from the camera).

    With R[k] the rotation of joint k from the T-pose into camera axes, bone j = 1…21 has
    ``directions[:, j - 1] = R[PARENTS[j]] @ REST_DIRECTIONS[j - 1]`` and
    ``roll[:, j - 1] = R[j] @ ROLL_AXES[j - 1]``. A body whose trunk has other proportions compares rotations by these
    two lines; of arms and legs, ``directions`` is the direction from the parent joint to the joint.

    Attributes:
        directions: [T, 21, 3] unit vectors.
        concentration: [T, 21] κ of von Mises-Fisher, rad⁻²: 1/κ is the variance of each of the two tangent angles.
        roll: [T, 21, 3] unit vectors.
        roll_concentration: [T, 21] κ of ``roll``, rad⁻².
    """

    directions: Floats32
    concentration: Floats32
    roll: Floats32
    roll_concentration: Floats32
    joints: tuple[str, ...] = JOINTS
    parents: tuple[int, ...] = PARENTS

    def __post_init__(self) -> None:
        count, bones = len(self.directions), len(self.joints) - 1
        for name in ("directions", "roll"):
            if (got := getattr(self, name).shape) != (count, bones, 3):
                raise InputError(name, expected=f"shape {(count, bones, 3)}", got=f"{got}")
        for name in ("concentration", "roll_concentration"):
            if (got := getattr(self, name).shape) != (count, bones):
                raise InputError(name, expected=f"shape {(count, bones)}", got=f"{got}")

    def __len__(self) -> int:
        return len(self.directions)
