"""The cameras that see people in motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rnd_runtime.core.rotations import axis_angle_to_matrix

from .motions import Floats32, Generator


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


def sampled_cameras(joints: Floats32, rng: Generator) -> Cameras:
    """Cameras around joints [B, T, 22, 3]: at phone heights and distances, aimed at the person's middle, tilted."""
    count = len(joints)
    middle = (joints.min((1, 2)) + joints.max((1, 2))) / 2
    floor = joints[..., 1].min((1, 2))
    extent = np.linalg.norm(joints.max((1, 2)) - joints.min((1, 2)), axis=-1)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    distance = np.exp(rng.uniform(np.log(1.9), np.log(7.0), count)) + 0.5 * np.maximum(extent - 2, 0)
    height = np.where(rng.random(count) < 0.4, rng.uniform(0.1, 3.2, count), rng.normal(1.3, 0.35, count))
    eye = middle + np.stack([np.sin(azimuth) * distance, 0 * height, np.cos(azimuth) * distance], -1)
    eye[:, 1] = floor + height
    aim = middle + rng.normal(0, 0.06, (count, 3)) * distance[:, None]
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
