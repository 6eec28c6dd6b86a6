"""Poses that nobody filmed, drawn at random: far from those that were, and near them."""

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

TURNED_JOINTS = 5
"""joints that a far pose turns: lengths are local, so it need not be likely, and several joints tell more at once. With
ten, what the network learned of them reached the poses that people do take: 0.3 dB under other lights"""
WIDEST_TURN = 2.2
"""radians that it turns them at most, about any axis: a knee's and a hip's reach"""
FASTEST_SHARE = 0.5
"""of its turns that a pose may have made within the window"""
WIDEST_SHAKE = 0.5
"""radians, the largest standard deviation of the turns that make a near pose of a filmed one"""
NUDGE, NUDGED_SPEED = 0.03, 0.09
"""standard deviations of what nudges a pose: of the columns of its rotations, and of joint velocities in rad/s. In slow
motion as much happens in a frame"""


def sampled_pose(skeleton: Skeleton, config: ModelConfig, rng: np.random.Generator) -> PoseInput:
    """Five joints turned far about any axis, and a window in which they come there from up to half-way."""
    joints = len(skeleton)
    turned = 1 + rng.permutation(joints - 1)[:TURNED_JOINTS]
    axes = rng.standard_normal((len(turned), 3))
    angles = np.zeros((joints, 3))
    angles[turned] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angles[turned] *= rng.uniform(0, WIDEST_TURN, (len(turned), 1))
    frames, fps = _window(config)
    reached = np.linspace(1 - rng.uniform(0, FASTEST_SHARE), 1, frames)
    motion = Motion(axis_angle_to_matrix(reached[:, None, None] * angles), np.zeros((frames, 3)), fps, skeleton.names)
    return pose_input(motion, skeleton, (frames - 1) / fps, config)


def perturbed_pose(
    motion: Motion, skeleton: Skeleton, time_s: float, config: ModelConfig, rng: np.random.Generator
) -> PoseInput:
    """The pose of ``motion`` at ``time_s`` and its window, every joint but the root turned a little, by the same
    throughout: what a person who was filmed might as well have done."""
    frames, fps = _window(config)
    window = motion.at(time_s + (np.arange(frames) - frames + 1) / fps)
    joints = len(skeleton)
    turns = rng.uniform(0, WIDEST_SHAKE) * rng.standard_normal((joints, 3))
    turns[0] = 0
    rotations = window.rotations @ axis_angle_to_matrix(turns)
    shaken = Motion(rotations, window.translations, fps, skeleton.names)
    return pose_input(shaken, skeleton, (frames - 1) / fps, config)


def jittered_pose(pose: PoseInput, rng: np.random.Generator) -> PoseInput:
    """What the networks are told of ``pose``, hardly changed: all poses of its window alike, and the velocities."""

    def noise(like: Tensor, sigma: float) -> Tensor:
        return sigma * torch.from_numpy(rng.standard_normal(like.shape)).to(like)

    window = pose.window + noise(pose.window[0], NUDGE)
    return replace(pose, window=window, velocity=pose.velocity + noise(pose.velocity, NUDGED_SPEED))


def _window(config: ModelConfig) -> tuple[int, float]:
    """Frames that a motion needs to fill the networks' window to its end, and how many of them a second has."""
    frames = max(config.window_poses, 2)
    return frames, (frames - 1) / config.window_seconds
