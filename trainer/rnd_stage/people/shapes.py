"""Body shapes: a smooth warp of the template's rest space, for its joints and clothes alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .garments import ramp
from .person import JOINTS

Floats = NDArray[np.float64]

SHOULDER, ARM_HEIGHT, ARM_DEPTH = JOINTS["left_shoulder"][0], 1.416, -0.02


@dataclass(frozen=True)
class Shape:
    """A body's difference from the template: factors on lengths across, and metres added by belly and bust."""

    height: float = 1.0
    shoulders: float = 1.0
    waist: float = 1.0
    hips: float = 1.0
    limbs: float = 1.0
    belly: float = 0.0
    bust: float = 0.0

    def warp(self, points: Floats) -> Floats:
        """Template rest points [N, 3] m → this body's."""
        x, y, z = np.asarray(points, np.float64).T
        reach, side = np.abs(x), np.sign(x)
        across = np.interp(
            y,
            [0.0, 0.45, 0.75, 0.92, 1.08, 1.22, 1.38, 1.46, 1.52],
            [1.0, 1.0, self.hips**0.5, self.hips, self.waist, self.waist**0.5, self.shoulders, self.shoulders, 1.0],
        )
        deep = np.interp(y, [0.6, 0.88, 1.08, 1.30, 1.46], [1.0, self.hips**0.7, self.waist, self.shoulders**0.5, 1.0])
        trunk = np.minimum(reach, SHOULDER)
        arm = reach - trunk
        on_arm = ramp(reach, SHOULDER, SHOULDER + 0.06) * (y > 1.2)
        thick = 1 + (self.limbs - 1) * on_arm
        new_x = side * (trunk * np.where(y > 1.2, self._shoulder_scale(across, y), across) + arm)
        new_y = np.where(on_arm > 0, ARM_HEIGHT + (y - ARM_HEIGHT) * thick, y)
        leg = ramp(y, 0.85, 0.70) * (reach < 0.4)
        axis = side * np.interp(y, [0.05, 0.49, 0.93], [0.131, 0.112, 0.090]) * across
        new_x = np.where(leg > 0, axis + (new_x - axis) * (1 + (self.limbs - 1) * leg * ramp(y, 0.10, 0.30)), new_x)
        depth = np.where(reach > SHOULDER, 1.0, deep) * np.where(
            leg > 0, 1 + (self.limbs - 1) * leg * ramp(y, 0.10, 0.3), 1
        )
        new_z = ARM_DEPTH + (z - ARM_DEPTH) * depth * np.where(on_arm > 0, thick, 1)
        front = ramp(z, 0.0, 0.08)
        new_z = new_z + self.belly * front * np.exp(-(((y - 1.02) / 0.11) ** 2) - (x / 0.13) ** 2)
        mounds = np.exp(-(((reach - 0.072) / 0.052) ** 2) - ((y - 1.285) / 0.052) ** 2)
        new_z = new_z + self.bust * front * mounds
        return self.height * np.stack([new_x, new_y, new_z], axis=1)

    def _shoulder_scale(self, across: Floats, y: Floats) -> Floats:
        """The scale across, at the arms' height that of the shoulders."""
        return across + (self.shoulders - across) * ramp(y, 1.33, 1.40) * ramp(y, 1.50, 1.47)
