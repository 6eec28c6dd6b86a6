"""Where a fit starts: rotations from bones' directions, positions from pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.skeleton import Skeleton
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_DIRECTIONS, ROLL_AXES, Lifted

Floats = NDArray[np.float64]

PARENT_PULL = 0.5
"""rad⁻²: a joint that nothing is known of rotates with its parent"""


def joint_rotations(lifted: Lifted) -> Floats:
    """World rotations [T, 22, 3, 3] from the T-pose, in the axes of ``lifted``: the nearest to all it says."""
    count = len(lifted)
    result = np.zeros((count, len(JOINTS), 3, 3))
    for joint, parent in enumerate(PARENTS):
        moment = PARENT_PULL * (result[:, parent] if parent >= 0 else np.zeros((count, 3, 3)))
        for child in range(1, len(JOINTS)):
            if PARENTS[child] == joint:
                moment = moment + _outer(lifted.directions, lifted.concentration, child, REST_DIRECTIONS)
        if joint:
            moment = moment + _outer(lifted.roll, lifted.roll_concentration, joint, ROLL_AXES)
        result[:, joint] = nearest_rotation(moment)
    return result


def _outer(vectors: NDArray[np.float32], kappa: NDArray[np.float32], joint: int, axes: Floats) -> Floats:
    target = vectors[:, joint - 1].astype(np.float64) * kappa[:, joint - 1, None]
    return target[:, :, None] * axes[joint - 1]


def nearest_rotation(moments: Floats) -> Floats:
    """Rotations [..., 3, 3] R that maximise tr(Rᵀ M)."""
    u, _, v = np.linalg.svd(moments)
    sign = np.sign(np.linalg.det(u @ v))
    u[..., :, 2] *= sign[..., None]
    return np.asarray(u @ v)


def local_rotations(world: Floats, skeleton: Skeleton) -> Floats:
    """Local rotations [T, J, 3, 3] of ``skeleton`` from world ones [T, 22, 3, 3]; other joints stay at rest."""
    local = np.tile(np.eye(3), (len(world), len(skeleton), 1, 1))
    for k, name in enumerate(JOINTS):
        parent = PARENTS[k]
        own = world[:, k] if parent < 0 else np.swapaxes(world[:, parent], -1, -2) @ world[:, k]
        local[:, skeleton.names.index(name)] = own
    return local


def root_positions(relative: Floats, pixels: Floats, weights: Floats, focal: float, centre: Floats) -> Floats:
    """Translations [T, 3] m that bring points [T, P, 3] onto ``pixels`` [T, P, 2]; camera axes, least squares."""
    rays = (pixels - centre) / focal
    count = len(relative)
    rows = np.zeros((count, relative.shape[1], 2, 3))
    rows[:, :, 0, 0] = rows[:, :, 1, 1] = 1
    rows[..., 2] = -rays
    right = rays * relative[..., 2:] - relative[..., :2]
    scaled = rows * weights[..., None, None]
    matrix = np.einsum("tpai,tpaj->tij", scaled, rows) + 1e-9 * np.eye(3)
    result = np.linalg.solve(matrix, np.einsum("tpai,tpa->ti", scaled, right)[..., None])[..., 0]
    depth = result[:, 2]
    sound = depth > 0
    usual = float(np.median(depth[sound])) if sound.any() else 3.0
    bad = ~sound | (depth < 0.4 * usual) | (depth > 2.5 * usual)
    if bad.any() and not bad.all():
        good = np.flatnonzero(~bad)
        for axis in range(3):
            result[bad, axis] = np.interp(np.flatnonzero(bad), good, result[good, axis])
    return np.asarray(result)
