"""Bodies of many shapes, their landmarks, and the cameras that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_OFFSETS

from .motions import MIRROR, Floats32, Generator

Floats = NDArray[np.float64]

_SIDES = ("left", "right")
_AXIAL = [JOINTS.index(n) for n in ("spine1", "spine2", "spine3", "neck", "head")]
_LIMBS = {
    "thigh": ("knee",),
    "shin": ("ankle",),
    "foot": ("foot",),
    "hips": ("hip",),
    "shoulders": ("collar", "shoulder"),
    "upper_arm": ("elbow",),
    "forearm": ("wrist",),
}


@dataclass(frozen=True, eq=False)
class Cameras:
    """Static cameras, one of each window.

    Attributes:
        rotations: [B, 3, 3] from the world (Y up) into camera axes (x right, y down, z away).
        translations: [B, 3] m.
    """

    rotations: Floats32
    translations: Floats32

    def seen(self, points: Floats32) -> Floats32:
        """Points [B, T, ..., 3] of the world in camera axes."""
        flat = points.reshape(len(points), -1, 3)
        moved = flat @ np.swapaxes(self.rotations, 1, 2) + self.translations[:, None]
        return moved.reshape(points.shape).astype(np.float32)


def sampled_offsets(count: int, rng: Generator) -> Floats32:
    """Bones [count, 22, 3] m from each joint's parent in the T-pose: children to tall adults, limbs of their own."""
    height = np.where(rng.random(count) < 0.08, rng.uniform(0.65, 0.9, count), rng.normal(1.0, 0.06, count))
    offsets = REST_OFFSETS * height[:, None, None]
    for ends in _LIMBS.values():
        scale = np.exp(rng.normal(0, 0.06, count))
        for side in _SIDES:
            uneven = np.exp(rng.normal(0, 0.01, count))
            for end in ends:
                offsets[:, JOINTS.index(f"{side}_{end}")] *= (scale * uneven)[:, None]
    trunk = np.exp(rng.normal(0, 0.06, (count, 1)))
    offsets[:, _AXIAL] *= (trunk * np.exp(rng.normal(0, 0.08, (count, len(_AXIAL)))))[..., None]
    bend = rng.normal(0, 1, (count, len(JOINTS), 3)) * [0.004, 0.01, 0.012]  # where a rig puts its joints
    bend[:, [JOINTS.index(f"{side}_{n}") for side in _SIDES for n in ("knee", "ankle", "elbow", "wrist")]] *= 0.4
    bend = (bend + bend[:, MIRROR] * [-1, 1, 1]) / 2
    return (offsets + bend).astype(np.float32)


def positions(rotations: Floats32, roots: Floats32, offsets: Floats32) -> Floats32:
    """Joints [B, T, 22, 3] m of rotations [B, T, 22, 3, 3], pelvis [B, T, 3] and bones [B, 22, 3]."""
    joints = np.empty((*rotations.shape[:3], 3), np.float32)
    joints[:, :, 0] = roots
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            joints[:, :, joint] = (
                joints[:, :, parent] + (rotations[:, :, parent] @ offsets[:, None, joint, :, None])[..., 0]
            )
    return joints


def sampled_cameras(joints: Floats32, rng: Generator) -> Cameras:
    """Cameras around joints [B, T, 22, 3]: at phone heights and distances, aimed at the person's middle, tilted."""
    count = len(joints)
    middle = (joints.min((1, 2)) + joints.max((1, 2))) / 2
    floor = joints[..., 1].min((1, 2))
    extent = np.linalg.norm(joints.max((1, 2)) - joints.min((1, 2)), axis=-1)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    distance = np.exp(rng.uniform(np.log(1.9), np.log(7.0), count)) + 0.5 * np.maximum(extent - 2, 0)
    height = np.where(rng.random(count) < 0.15, rng.uniform(-0.3, 3.2, count), rng.normal(1.3, 0.35, count))
    eye = middle + np.stack([np.sin(azimuth) * distance, 0 * height, np.cos(azimuth) * distance], -1)
    eye[:, 1] = floor + height
    aim = middle + rng.normal(0, 0.12, (count, 3)) * [1, 1, 1]
    away = aim - eye
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    right = np.cross(away, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    frame = np.stack([right, np.cross(away, right), away], 1)  # rows: x right, y down, z away
    roll = np.zeros((count, 3))
    roll[:, 2] = np.radians(rng.normal(0, 3, count))
    rotation = axis_angle_to_matrix(roll) @ frame
    translation = -(rotation @ eye[..., None])[..., 0]
    return Cameras(rotation.astype(np.float32), translation.astype(np.float32))
