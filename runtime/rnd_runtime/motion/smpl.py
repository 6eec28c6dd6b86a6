"""Joints of the SMPL family and the pelvis of its mean bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMPL_NAMES: tuple[str, ...] = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle"),
    *("right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    *("left_hand", "right_hand"),
)
"""SMPL's 24 joints in SMPL's order: the default skeleton."""

SMPL_PARENTS: tuple[int, ...] = (*(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8), *(9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21))

_FINGERS = tuple(f"{name}{k}" for name in ("index", "middle", "pinky", "ring", "thumb") for k in "123")
_HANDS = tuple(f"{side}_{finger}" for side in ("left", "right") for finger in _FINGERS)
SMPLH_NAMES: tuple[str, ...] = SMPL_NAMES[:22] + _HANDS
SMPLX_NAMES: tuple[str, ...] = (*SMPL_NAMES[:22], "jaw", "left_eye", "right_eye", *_HANDS)
NAMES_BY_COUNT = {22: SMPL_NAMES[:22], 24: SMPL_NAMES, 52: SMPLH_NAMES, 55: SMPLX_NAMES}

# m, pelvis of the mean body (betas 0); translations of these files are of the origin
SMPL_REST_ROOT: NDArray[np.float64] = np.array([-0.0018, -0.2233, 0.0282])
SMPLX_REST_ROOT: NDArray[np.float64] = np.array([0.0031, -0.3514, 0.0120])
