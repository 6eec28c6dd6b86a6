"""Where a fit starts: rotations from bones' directions, bones' directions from points, positions from pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.skeleton import Skeleton
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_DIRECTIONS, ROLL_AXES, Lifted

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

PARENT_PULL = 0.5
"""rad⁻²: a joint that nothing is known of rotates with its parent"""
HINT_CONCENTRATION = 16.0
"""rad⁻² of the landmark network's 3D: it errs by 14° along each axis"""


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


def bones_of_points(points: Floats, known: Bools, concentration: float = HINT_CONCENTRATION) -> Lifted:
    """Bones of a person of whom points are known.

    Args:
        points: [T, 33, 3] BLAZEPOSE's, m, camera axes; only differences count.
        known: [T, 33] whether a point is.
        concentration: rad⁻² of a bone of which both ends are known.
    """
    count = len(points)
    directions, rolls = np.zeros((count, 21, 3)), np.zeros((count, 21, 3))
    kappa, roll_kappa = np.full((count, 21), 1e-3), np.full((count, 21), 1e-3)
    directions[:], rolls[:] = REST_DIRECTIONS * [1, -1, -1], ROLL_AXES * [1, -1, -1]
    world: dict[int, Floats] = {}

    def middle(a: int, b: int) -> Floats:
        return 0.5 * (points[:, a] + points[:, b])

    hips, shoulders = middle(23, 24), middle(11, 12)
    up = _unit(shoulders - hips)
    pelvis = _frame(points[:, 23] - points[:, 24], up)
    chest = _frame(points[:, 11] - points[:, 12], up)
    trunk = known[:, [11, 12, 23, 24]].all(1)
    head = _frame(points[:, 7] - points[:, 8], up)
    face = _frame_forward(points[:, 7] - points[:, 8], points[:, 0] - middle(7, 8))
    seen_face = np.asarray(known[:, [0, 7, 8]].all(1))
    head = np.where(seen_face[:, None, None], face, chest)
    world[0], world[9], world[15] = pelvis, chest, head
    world[3] = nearest_rotation(2 * pelvis + chest)
    world[6] = nearest_rotation(pelvis + 2 * chest)
    world[12] = nearest_rotation(chest + head)
    world[13] = world[14] = chest
    for joint in range(1, 22):
        parent = PARENTS[joint]
        if parent in world:
            directions[:, joint - 1] = world[parent] @ REST_DIRECTIONS[joint - 1]
            kappa[:, joint - 1] = concentration * trunk * (0.3 if joint in (13, 14, 16, 17) else 1)
        if joint in world:
            rolls[:, joint - 1] = world[joint] @ ROLL_AXES[joint - 1]
            roll_kappa[:, joint - 1] = concentration * (seen_face if joint == 15 else trunk) * 0.5
    for sign, right in ((1.0, 0), (-1.0, 1)):
        chain = {4: (23, 25), 7: (25, 27), 10: (29, 31), 18: (11, 13), 20: (13, 15)}
        for joint, (a, b) in chain.items():
            a, b, row = a + right, b + right, joint + right - 1
            directions[:, row] = _unit(points[:, b] - points[:, a])
            if joint == 10:  # the sole points from heel to toes; the bone falls from the ankle to the toes' base
                directions[:, row] = _foot(directions[:, row], directions[:, 7 + right - 1])
            kappa[:, row] = concentration * (known[:, a] & known[:, b])
        # the hinge's axis is across the plane of the bent limb
        for upper, lower, rolling in ((4, 7, (1, 4)), (18, 20, (16, 18))):
            across: Floats = np.cross(directions[:, upper + right - 1], directions[:, lower + right - 1])
            bent = np.linalg.norm(across, axis=1)
            axis = _unit(across) * (1 if upper == 4 else sign)
            both = np.minimum(kappa[:, upper + right - 1], kappa[:, lower + right - 1])
            for joint in rolling:
                rolls[:, joint + right - 1] = axis
                roll_kappa[:, joint + right - 1] = np.maximum(both * bent**2, 1e-3)
    return Lifted(
        directions.astype(np.float32),
        np.maximum(kappa, 1e-3).astype(np.float32),
        rolls.astype(np.float32),
        np.maximum(roll_kappa, 1e-3).astype(np.float32),
    )


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


def _frame(left: Floats, up: Floats) -> Floats:
    """Rotations [T, 3, 3] that take X to ``left`` and Y close to ``up``."""
    x = _unit(left)
    y = _unit(up - (up * x).sum(-1, keepdims=True) * x)
    return np.stack([x, y, np.cross(x, y)], -1)


def _frame_forward(left: Floats, forward: Floats) -> Floats:
    x = _unit(left)
    z = _unit(forward - (forward * x).sum(-1, keepdims=True) * x)
    return np.stack([x, np.cross(z, x), z], -1)


def _foot(sole: Floats, shin: Floats) -> Floats:
    """Ankle → toes' base: the sole's direction, 24° down from it in the plane of sole and shin."""
    down = _unit(shin - (shin * sole).sum(-1, keepdims=True) * sole)
    return _unit(0.91 * sole + 0.41 * down)


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
