"""The SMPL family's joints, and where its mean bodies have their pelvis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.skeleton import SMPL_NAMES

_FINGERS = tuple(f"{name}{k}" for name in ("index", "middle", "pinky", "ring", "thumb") for k in "123")
_HANDS = tuple(f"{side}_{finger}" for side in ("left", "right") for finger in _FINGERS)
SMPLH_NAMES: tuple[str, ...] = SMPL_NAMES[:22] + _HANDS
SMPLX_NAMES: tuple[str, ...] = (*SMPL_NAMES[:22], "jaw", "left_eye", "right_eye", *_HANDS)
NAMES_BY_COUNT = {22: SMPL_NAMES[:22], 24: SMPL_NAMES, 52: SMPLH_NAMES, 55: SMPLX_NAMES}

# Where SMPL's mean body (betas 0) has its pelvis. Files of that family place the origin, not the pelvis.
SMPL_REST_ROOT: NDArray[np.float64] = np.array([-0.0018, -0.2233, 0.0282])
SMPLX_REST_ROOT: NDArray[np.float64] = np.array([0.0031, -0.3514, 0.0120])
