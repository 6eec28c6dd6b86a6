"""How a forearm shares a twist between its two ends before it is skinned, as skin and the two bones beneath it do.

A hand that is rotated by 120° pinches the wrist ("candy wrapper") where two bones share the skin. The forearm is
therefore rotated about its own axis, which moves neither elbow nor wrist and leaves the hand as it was::

    τ = atan2(a · u, tr R − uᵀRu)              twist of R about u, a = (R₃₂ − R₂₃, R₁₃ − R₃₁, R₂₁ − R₁₂)
    s = min(1, 2 (1 + uᵀRu))                   1 but where R bends by more than 120°, 0 at 180°, where τ is nobody's
    h = s · sign(τ) · 60° · sin² π (|τ| − 60°)/120°      beyond 60°, else 0
    δ = h(elbow) − h(wrist),   R_elbow ← R_elbow exp(−δ u),   R_wrist ← exp(δ u) R_wrist

Up to 60° nothing changes, to the bit; a twist of 120° comes to 60° at each end. h falls back to 0 at 180°, where τ
jumps to −180°.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.motion.interpolation import turned
from rnd_runtime.motion.skeleton import Skeleton, bone_transforms

Floats = NDArray[np.float64]

FREE = np.pi / 3
"""radians that an end is twisted by before it hands anything on; dancers' forearms in AIST++ keep to a fifth of it"""
MAX_SHARE = np.pi / 3
"""radians that an end hands on at most, of a twist of (π + FREE)/2"""


def skinning_bones(skeleton: Skeleton, rotations: ArrayLike, translation: ArrayLike) -> NDArray[np.float32]:
    """``.skeleton.bone_transforms`` [..., J, 3, 4] of a pose whose forearms share their twists."""
    return bone_transforms(skeleton, share_twists(skeleton, rotations), translation)


def share_twists(skeleton: Skeleton, rotations: ArrayLike) -> Floats:
    """Local ``rotations`` [..., J, 3, 3] with forearms turned so that no end bears a twist alone.

    The same array where no forearm is twisted by more than FREE, or the skeleton has none by SMPL's names.
    """
    rotations = shared = np.asarray(rotations, np.float64)
    for elbow, wrist, axis, angles in twist_angles(skeleton, rotations):
        if shared is rotations:
            shared = np.array(rotations, order="C")
        _rotate_all(shared.reshape(-1, *shared.shape[-3:]), elbow, wrist, axis, angles.reshape(-1))
    return shared


def twist_angles(skeleton: Skeleton, rotations: Floats) -> Iterator[tuple[int, int, Floats, Floats]]:
    """Of each forearm that shares a twist its elbow, its wrist, u [3] and δ [...] radians; rotations [..., J, 3, 3]."""
    for elbow, wrist, axis in forearms(skeleton):
        angles = np.empty(rotations.shape[:-3])
        _shares(rotations.reshape(-1, *rotations.shape[-3:]), elbow, wrist, axis, angles.reshape(-1))
        if angles.any():
            yield elbow, wrist, axis, angles


@lru_cache(maxsize=16)
def forearms(skeleton: Skeleton) -> tuple[tuple[int, int, Floats], ...]:
    """Of each forearm its elbow, its wrist and its axis [3], unit, from one to the other at rest."""
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
def _handed_on(rotation, axis):  # type: ignore[no-untyped-def]
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
    return _handed_on(rotations[elbow], axis) - _handed_on(rotations[wrist], axis)


@njit(nogil=True, cache=True, error_model="numpy")
def _rotate_all(rotations, elbow, wrist, axis, angles):  # type: ignore[no-untyped-def]
    for pose in range(len(rotations)):
        hand_on(rotations[pose], elbow, wrist, axis, angles[pose])


@njit(error_model="numpy")
def hand_on(rotations, elbow, wrist, axis, angle):  # type: ignore[no-untyped-def]
    """Turn the forearm of one pose [J, 3, 3] by δ, and the hand back."""
    back = -angle * axis[0], -angle * axis[1], -angle * axis[2]
    before, after = rotations[elbow].copy(), np.empty((3, 3))
    turned(before, back, rotations[elbow])
    for row in range(3):
        for column in range(3):
            before[column, row] = rotations[wrist, row, column]
    turned(before, back, after)
    for row in range(3):
        for column in range(3):
            rotations[wrist, row, column] = after[column, row]
