"""Rotations in float64: axis-angle in files, matrices inside, quaternions (wxyz) in between.

All functions broadcast over leading dimensions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def axis_angle_to_matrix(axis_angle: ArrayLike) -> Floats:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] rad (Rodrigues), exact near zero."""
    vector = np.asarray(axis_angle, np.float64)
    angle = np.sqrt((vector * vector).sum(-1))[..., None, None]
    # np.sinc(x) = sin(πx)/(πx), accurate where sin θ/θ and (1−cos θ)/θ² are 0/0
    sine = np.sinc(angle / np.pi)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    cross = _cross_matrix(vector)
    matrix: Floats = np.eye(3) + sine * cross + versine * (cross @ cross)
    return matrix


def matrix_to_axis_angle(matrix: ArrayLike) -> Floats:
    """Axis-angle [..., 3] rad, angle in [0, π], of rotation matrices [..., 3, 3].

    Accurate near 0 and π, where ``acos((trace − 1)/2)`` loses half the digits.
    """
    quaternion = matrix_to_quaternion(matrix)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = np.sqrt((xyz * xyz).sum(-1, keepdims=True))
    angle = 2 * np.arctan2(sine, w)
    small = sine < 1e-9  # θ/sin(θ/2) → 2, with an error of θ²/12
    return np.where(small, 2.0, angle / np.where(small, 1.0, sine)) * xyz


def matrix_to_quaternion(matrix: ArrayLike) -> Floats:
    """Unit quaternions [..., 4] (wxyz, w ≥ 0) of rotation matrices [..., 3, 3].

    Source: Shepperd 1978 (division by the largest component).
    """
    m = np.asarray(matrix, np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)  # 4q²
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, yz, zx = m[..., 0, 1] + m[..., 1, 0], m[..., 1, 2] + m[..., 2, 1], m[..., 2, 0] + m[..., 0, 2]
    products = np.stack(  # row i is 4 q_i q; all rows are parallel
        [
            np.stack([squares[..., 0], wx, wy, wz], -1),
            np.stack([wx, squares[..., 1], xy, zx], -1),
            np.stack([wy, xy, squares[..., 2], yz], -1),
            np.stack([wz, zx, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    largest = squares.argmax(-1)[..., None, None]
    quaternion = np.take_along_axis(products, largest, -2)[..., 0, :]
    quaternion /= np.sqrt((quaternion * quaternion).sum(-1, keepdims=True))
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_to_matrix(quaternion: ArrayLike) -> Floats:
    """Rotation matrices [..., 3, 3] of non-zero quaternions [..., 4] (wxyz) of any length."""
    q = np.asarray(quaternion, np.float64)
    q = q / np.sqrt((q * q).sum(-1, keepdims=True))
    cross = _cross_matrix(q[..., 1:])
    matrix: Floats = np.eye(3) + 2 * q[..., :1, None] * cross + 2 * (cross @ cross)
    return matrix


def slerp_matrices(a: ArrayLike, b: ArrayLike, t: ArrayLike) -> Floats:
    """Rotations [..., 3, 3] on the shortest path from ``a`` (t = 0) to ``b`` (t = 1), at constant speed.

    ``t`` broadcasts against the leading dimensions of ``a`` and ``b`` [..., 3, 3].
    """
    a = np.asarray(a, np.float64)
    step = matrix_to_axis_angle(np.swapaxes(a, -1, -2) @ np.asarray(b, np.float64))
    return a @ axis_angle_to_matrix(np.asarray(t, np.float64)[..., None] * step)


def rotation_6d(matrix: ArrayLike) -> Floats:
    """The first two columns of [..., 3, 3], concatenated: [..., 6] (Zhou et al. 2019)."""
    m = np.asarray(matrix, np.float64)
    return np.concatenate([m[..., :, 0], m[..., :, 1]], -1)


def _cross_matrix(vector: Floats) -> Floats:
    """[..., 3, 3] with ``_cross_matrix(a) @ b == cross(a, b)``."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape[:-1], 3, 3)
