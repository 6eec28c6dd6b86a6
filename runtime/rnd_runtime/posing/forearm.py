"""Distribution of a forearm's twist over its two ends before skinning.

A hand twisted by 120° pinches the wrist ("candy wrapper"). The forearm is therefore rotated about its own axis, which
leaves elbow, wrist and hand where they were::

    τ = atan2(a · u, tr R − uᵀRu)              twist of R about u, a = (R₃₂ − R₂₃, R₁₃ − R₃₁, R₂₁ − R₁₂)
    s = min(1, 2 (1 + uᵀRu))                   1 up to a bend of 120°, 0 at 180°, where τ is undefined
    h = s · sign(τ) · 60° · sin² π (|τ| − 60°)/120°      beyond 60°, else 0
    δ = h(elbow) − h(wrist),   R_elbow ← R_elbow exp(−δ u),   R_wrist ← exp(δ u) R_wrist

Twists up to 60° stay to the bit; 120° becomes 60° at each end. h is 0 at 180°, where τ jumps to −180°.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.motion.interpolation import rotated_by
from rnd_runtime.motion.skeleton import Skeleton, bone_transforms

Floats = NDArray[np.float64]

FREE = np.pi / 3
"""rad of twist at one end that stay there; forearms in AIST++ reach a fifth of it"""
MAX_SHARE = np.pi / 3
"""rad, max twist moved to the other end, at a twist of (π + FREE)/2"""


def skinning_bones(skeleton: Skeleton, rotations: ArrayLike, translation: ArrayLike) -> NDArray[np.float32]:
    """``.skeleton.bone_transforms`` [..., J, 3, 4] of a pose with shared forearm twists."""
    return bone_transforms(skeleton, share_twists(skeleton, rotations), translation)


def share_twists(skeleton: Skeleton, rotations: ArrayLike) -> Floats:
    """Local ``rotations`` [..., J, 3, 3] with shared forearm twists.

    Returns the same array where no twist exceeds FREE or the skeleton has no forearms by SMPL's names.
    """
    rotations = shared = np.asarray(rotations, np.float64)
    for elbow, wrist, axis, angles in twist_angles(skeleton, rotations):
        if shared is rotations:
            shared = np.array(rotations, order="C")
        _rotate_all(shared.reshape(-1, *shared.shape[-3:]), elbow, wrist, axis, angles.reshape(-1))
    return shared


def twist_angles(skeleton: Skeleton, rotations: Floats) -> Iterator[tuple[int, int, Floats, Floats]]:
    """Yield elbow, wrist, axis u [3] and δ [...] rad of each forearm that shares a twist; rotations [..., J, 3, 3]."""
    for elbow, wrist, axis in forearms(skeleton):
        angles = np.empty(rotations.shape[:-3])
        _shares(rotations.reshape(-1, *rotations.shape[-3:]), elbow, wrist, axis, angles.reshape(-1))
        if angles.any():
            yield elbow, wrist, axis, angles


@lru_cache(maxsize=16)
def forearms(skeleton: Skeleton) -> tuple[tuple[int, int, Floats], ...]:
    """Elbow, wrist and unit axis [3] (elbow to wrist, rest pose) of each forearm."""
    found = []
    for side in ("left", "right"):
        ends = [f"{side}_{end}" for end in ("elbow", "wrist")]
        if not set(ends) <= set(skeleton.names):
            continue
        elbow, wrist = map(skeleton.names.index, ends)
        bone = skeleton.rest_joints[wrist] - skeleton.rest_joints[elbow]
        length = np.linalg.norm(bone)
        if skeleton.parents[wrist] == elbow and length > 0:
            found.append((elbow, wrist, bone / length))
    return tuple(found)


@njit(inline="always")
def _moved_twist(rotation, axis):  # type: ignore[no-untyped-def]
    """h of one rotation [3, 3] about ``axis`` [3]."""
    along = 0.0
    for row in range(3):
        for column in range(3):
            along += axis[row] * rotation[row, column] * axis[column]
    sine = (
        axis[0] * (rotation[2, 1] - rotation[1, 2])
        + axis[1] * (rotation[0, 2] - rotation[2, 0])
        + axis[2] * (rotation[1, 0] - rotation[0, 1])
    )
    twist = np.arctan2(sine, rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - along)
    beyond = (abs(twist) - FREE) / (np.pi - FREE)
    if beyond <= 0:
        return 0.0
    share = MAX_SHARE * np.sin(np.pi * beyond) ** 2 * max(min(1.0, 2 * (1 + along)), 0.0)
    return share if twist > 0 else -share


@njit(nogil=True, cache=True, error_model="numpy")
def _shares(rotations, elbow, wrist, axis, angles):  # type: ignore[no-untyped-def]
    """Fill ``angles`` [B] with δ of ``rotations`` [B, J, 3, 3]."""
    for pose in range(len(rotations)):
        angles[pose] = share(rotations[pose], elbow, wrist, axis)


@njit(error_model="numpy")
def share(rotations, elbow, wrist, axis):  # type: ignore[no-untyped-def]
    """δ of one pose [J, 3, 3]."""
    return _moved_twist(rotations[elbow], axis) - _moved_twist(rotations[wrist], axis)


@njit(nogil=True, cache=True, error_model="numpy")
def _rotate_all(rotations, elbow, wrist, axis, angles):  # type: ignore[no-untyped-def]
    for pose in range(len(rotations)):
        rotate_forearm(rotations[pose], elbow, wrist, axis, angles[pose])


@njit(error_model="numpy")
def rotate_forearm(rotations, elbow, wrist, axis, angle):  # type: ignore[no-untyped-def]
    """Rotate the forearm of one pose [J, 3, 3] by −δ, and the hand back."""
    back = -angle * axis[0], -angle * axis[1], -angle * axis[2]
    before, after = rotations[elbow].copy(), np.empty((3, 3))
    rotated_by(before, back, rotations[elbow])
    for row in range(3):
        for column in range(3):
            before[column, row] = rotations[wrist, row, column]
    rotated_by(before, back, after)
    for row in range(3):
        for column in range(3):
            rotations[wrist, row, column] = after[column, row]
