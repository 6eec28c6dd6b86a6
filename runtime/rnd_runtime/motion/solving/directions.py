"""Directions, rotations between them, and their means over time; all broadcast over leading dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.rotations import axis_angle_to_matrix

Floats = NDArray[np.float64]

_TINY = 1e-12
_MEDIAN_STEPS = 12
_MEDIAN_FLOOR = np.radians(5)  # of a residual, where the weight of the median would grow without bound


def unit(vector: Floats) -> Floats:
    """[..., 3] of length one; zero stays zero."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    result: Floats = vector / np.maximum(length, _TINY)
    return result


def across(vector: Floats, axis: Floats) -> Floats:
    """The part of ``vector`` [..., 3] perpendicular to the unit ``axis``, of length one."""
    return unit(vector - (vector * axis).sum(-1, keepdims=True) * axis)


def swing(a: Floats, b: Floats) -> Floats:
    """The smallest rotation [..., 3, 3] from the unit direction ``a`` [..., 3] to ``b``."""
    a, b = np.broadcast_arrays(a, b)
    cosine = (a * b).sum(-1)[..., None, None]
    x, y, z = np.moveaxis(np.cross(a, b), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    rotation = np.eye(3) + cross + cross @ cross / np.maximum(1 + cosine, _TINY)
    aside = across(np.eye(3)[np.abs(a).argmin(-1)], unit(a))
    half_turn = 2 * aside[..., :, None] * aside[..., None, :] - np.eye(3)
    result: Floats = np.where(cosine > -1 + 1e-9, rotation, half_turn)
    return result


def about(axis: Floats, angle: Floats | float) -> Floats:
    """Rotations [..., 3, 3] by ``angle`` [...] rad about the unit ``axis`` [..., 3]."""
    return axis_angle_to_matrix(np.asarray(angle)[..., None] * axis)


def angle_about(axis: Floats, a: Floats, b: Floats) -> Floats:
    """Angle [...] rad from ``a`` to ``b`` about the unit ``axis``, seen along it."""
    a, b = across(a, axis), across(b, axis)
    angle: Floats = np.arctan2((np.cross(a, b) * axis).sum(-1), (a * b).sum(-1))
    return angle


def body_frame(left: Floats, up: Floats) -> Floats:
    """Rotations [..., 3, 3] with columns ``left``, what is ``up`` across it, and forward."""
    left = unit(left)
    up = across(up, left)
    return np.stack([left, up, np.cross(left, up)], -1)


def angle_between(a: Floats, b: Floats) -> Floats:
    """Angle [...] rad of the rotation between ``a`` and ``b`` [..., 3, 3]."""
    cosine = ((a * b).sum((-2, -1)) - 1) / 2
    angle: Floats = np.arccos(np.clip(cosine, -1, 1))
    return angle


def mean_rotation(rotations: Floats) -> Floats:
    """The rotation [3, 3] nearest to the mean of ``rotations`` [F, 3, 3]."""
    return _nearest_rotation(rotations.mean(0))


def median_rotation(rotations: Floats, weights: Floats | None = None) -> Floats:
    """The rotation [3, 3] with the least sum of weighted angles to ``rotations`` [F, 3, 3]."""
    weights = np.ones(len(rotations)) if weights is None else weights
    mean = _nearest_rotation(np.tensordot(weights, rotations, 1))
    for _ in range(_MEDIAN_STEPS):
        residuals = np.maximum(angle_between(rotations, mean), _MEDIAN_FLOOR)
        mean = _nearest_rotation(np.tensordot(weights / residuals, rotations, 1))
    return mean


def weighted_median(values: Floats, weights: Floats) -> float:
    """The value at half of the weights' sum; 0 without weights."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    if not len(values) or total[-1] <= 0:
        return 0.0
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _nearest_rotation(matrix: Floats) -> Floats:
    if not np.isfinite(matrix).all():
        return np.full((3, 3), np.nan)
    u, _, v = np.linalg.svd(matrix)
    u[:, 2] *= np.sign(np.linalg.det(u @ v))
    rotation: Floats = u @ v
    return rotation
