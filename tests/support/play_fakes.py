"""A body of balls on SMPL's joints, in place of an avatar file, and a light that is white everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rnd_runtime.avatar.file import PlayerAdvice
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_runtime.shading.light import Light

BALL_RADIUS = 0.1  # m
POINTS_PER_JOINT = 120
FULL_VISIBILITY = np.sqrt(4 * np.pi)  # the constant function 1 as its first coefficient

REST_JOINTS = np.array(
    [
        *([0, 0.95, 0], [0.07, 0.86, 0], [-0.07, 0.86, 0], [0, 1.06, 0], [0.1, 0.48, 0], [-0.1, 0.48, 0]),
        *([0, 1.2, 0], [0.09, 0.08, 0], [-0.09, 0.08, 0], [0, 1.25, 0], [0.11, 0.02, 0.1], [-0.11, 0.02, 0.1]),
        *([0, 1.46, 0], [0.07, 1.38, 0], [-0.07, 1.38, 0], [0, 1.55, 0], [0.18, 1.4, 0], [-0.18, 1.4, 0]),
        *([0.44, 1.4, 0], [-0.44, 1.4, 0], [0.69, 1.4, 0], [-0.69, 1.4, 0], [0.78, 1.4, 0], [-0.78, 1.4, 0]),
    ]
)


def fake_skeleton() -> Skeleton:
    return smpl_skeleton(REST_JOINTS)


class Encoded(NamedTuple):
    avatar: FakeAvatar
    motion: Motion
    time: float
    bones: np.ndarray  # [J, 3, 4] m, rest pose → world
    root: np.ndarray  # it is posed in the world
    seconds: dict[str, float]


@dataclass(frozen=True)
class FakeAvatar:
    """What the player asks of an Avatar."""

    skeleton: Skeleton = field(default_factory=fake_skeleton)
    trained_light: np.ndarray = field(default_factory=lambda: np.full((32, 64, 3), 0.5, np.float32))
    spacing: float = 0.02
    advice: PlayerAdvice = field(default_factory=PlayerAdvice)

    def level(self, number: int) -> FakeAvatar | None:
        """It has no others than the whole."""
        return self if number == 0 else None

    detail = level  # both have what there is of it

    def encode(self, motion: Motion, time: float) -> Encoded:
        now = motion.at([time])
        joints = self.skeleton.joint_transforms(now.rotations[0], now.translations[0])[:, :3]
        joints[:, :, 3] -= np.einsum("jab,jb->ja", joints[:, :, :3], self.skeleton.rest_joints)
        return Encoded(self, motion, time, joints, np.eye(4), {})

    def posed(self, encoded: Encoded) -> Gaussians:
        return self.pose(encoded.motion, encoded.time)

    def joints(self, encoded: Encoded) -> np.ndarray:
        now = encoded.motion.at([encoded.time])
        return self.skeleton.joint_transforms(now.rotations[0], now.translations[0])[:, :3, 3]

    def scale_albedo(self, gain: tuple[float, float, float]) -> None:
        """Its albedo stays."""

    def unposed(self, encoded: Encoded) -> None:
        """It has no networks."""

    def pose(self, motion: Motion, time: float) -> Gaussians:
        now = motion.at([time])
        joints = self.skeleton.joint_transforms(now.rotations[0], now.translations[0])[:, :3, 3]
        k = np.arange(POINTS_PER_JOINT) + 0.5
        polar, azimuth = np.arccos(1 - 2 * k / POINTS_PER_JOINT), np.pi * (1 + 5**0.5) * k
        normals = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=-1)
        means = (joints[:, None] + BALL_RADIUS * normals).reshape(-1, 3)
        count = len(means)
        visibility = np.zeros((count, 16))
        visibility[:, 0] = FULL_VISIBILITY
        arrays = (
            means,
            np.tile([2e-4, 0, 0, 2e-4, 0, 2e-4], (count, 1)),
            np.full(count, 0.95),
            np.tile(normals, (len(joints), 1)),
            np.tile([0.6, 0.4, 0.2], (count, 1)),
            np.full(count, 0.5),
            visibility,
            now.rotations[0, 0],
        )
        return Gaussians(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def fake_motion(frames: int = 12, fps: float = 30.0) -> Motion:
    """The body walks 0.5 m towards its left and lifts its left arm."""
    angles = np.zeros((frames, 24, 3))
    angles[:, 16, 2] = np.linspace(0, 1, frames)
    translations = np.linspace([0, 0, 0], [0.5, 0, 0], frames)
    return Motion(axis_angle_to_matrix(angles), translations, fps, SMPL_NAMES, "fake")


def white_light(radiance: float = 1.0) -> Light:
    return Light(np.full((16, 32, 3), radiance, np.float32))
