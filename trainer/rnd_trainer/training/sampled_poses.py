"""Random unseen poses: far from the training poses, and near them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.model import PoseInput

from .data import pose_input

ROTATED_JOINTS = 5
"""joints rotated in a far pose; ten cost 0.3 dB under other lights"""
MAX_ROTATION = 2.2
"""largest rotation of such a joint, rad: the range of a knee or hip"""
MAX_WINDOW_SHARE = 0.5
"""largest share of the rotation that happens within the motion window"""
MAX_PERTURBATION = 0.5
"""largest standard deviation of the rotations that perturb a training pose, rad"""
JITTER, VELOCITY_JITTER = 0.03, 0.09
"""standard deviations of the jitter of rotation columns (rad) and joint velocities (rad/s): one frame of slow motion"""
VELOCITY_NOISE_RATE = 10.0
"""noise on the velocities of a training image's pose (rad/s) over the ``pose_noise`` on its rotations (rad), 1/s"""


def sampled_pose(skeleton: Skeleton, config: ModelConfig, rng: np.random.Generator) -> PoseInput:
    """A pose with five joints rotated about random axes, and a motion window that ends in it."""
    joints = len(skeleton)
    rotated = 1 + rng.permutation(joints - 1)[:ROTATED_JOINTS]
    axes = rng.standard_normal((len(rotated), 3))
    angles = np.zeros((joints, 3))
    angles[rotated] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angles[rotated] *= rng.uniform(0, MAX_ROTATION, (len(rotated), 1))
    frames, fps = _window(config)
    reached = np.linspace(1 - rng.uniform(0, MAX_WINDOW_SHARE), 1, frames)
    motion = Motion(axis_angle_to_matrix(reached[:, None, None] * angles), np.zeros((frames, 3)), fps, skeleton.names)
    return pose_input(motion, skeleton, (frames - 1) / fps, config)


def perturbed_pose(
    motion: Motion, skeleton: Skeleton, time_s: float, config: ModelConfig, rng: np.random.Generator
) -> PoseInput:
    """The pose of ``motion`` at ``time_s`` seconds, each joint but the root rotated by a constant over the window."""
    frames, fps = _window(config)
    window = motion.at(time_s + (np.arange(frames) - frames + 1) / fps)
    joints = len(skeleton)
    perturbation = rng.uniform(0, MAX_PERTURBATION) * rng.standard_normal((joints, 3))
    perturbation[0] = 0
    rotations = window.rotations @ axis_angle_to_matrix(perturbation)
    perturbed = Motion(rotations, window.translations, fps, skeleton.names)
    return pose_input(perturbed, skeleton, (frames - 1) / fps, config)


def jittered_pose(
    pose: PoseInput,
    generator: np.random.Generator | torch.Generator,
    jitter: float = JITTER,
    velocity_jitter: float = VELOCITY_JITTER,
) -> PoseInput:
    """``pose`` with noise on the encoders' input: one for all poses of its window, one for the velocities.

    The bones stay exact. ``jitter`` (rad) and ``velocity_jitter`` (rad/s) are standard deviations.
    """

    def noise(like: Tensor, sigma: float) -> Tensor:
        if isinstance(generator, torch.Generator):
            return sigma * torch.randn(like.shape, generator=generator).to(like)
        return sigma * torch.from_numpy(generator.standard_normal(like.shape)).to(like)

    window = pose.window + noise(pose.window[0], jitter)
    return replace(pose, window=window, velocity=pose.velocity + noise(pose.velocity, velocity_jitter))


def _window(config: ModelConfig) -> tuple[int, float]:
    """Frames of a motion that fills the networks' window, and its frame rate in Hz."""
    frames = max(config.window_poses, 2)
    return frames, (frames - 1) / config.window_seconds
