"""Difference between an exported file, run by onnxruntime, and the model in torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from rnd_export.reduce.variant import Variant
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import Precision
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.window import motion_window
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.training.data import pose_input

MAX_FRAMES = 1_000  # 30 s with 30 000 Gaussians
MAX_WEIGHT_ERROR = 1e-4  # of a skinning weight
MAX_POSITION_ERROR_M = 1e-4
MAX_RELATIVE_ERROR = 1e-3  # of a unit normal, a visibility coefficient, and a covariance over its longest axis
MAX_P99_M: dict[Precision, float] = {"f32": MAX_POSITION_ERROR_M, "f16": 1e-3, "int8": 3e-3}  # of positions


@dataclass(frozen=True)
class ParityError:
    """Largest differences between onnxruntime and torch over a motion; of positions the 99th percentile too."""

    frames: int
    weights: float
    position_m: float
    position_p99_m: float
    normal: float
    visibility: float
    covariance_relative: float

    def limits(self, variant: Variant) -> list[tuple[str, float, float]]:
        """(name, measured, allowed) of the values that ``variant`` does not reduce."""
        if variant != Variant(precision=variant.precision):
            return []
        if variant.precision != "f32":
            return [("positions (99 %)", self.position_p99_m, MAX_P99_M[variant.precision])]
        return [
            ("skinning weights", self.weights, MAX_WEIGHT_ERROR),
            ("positions", self.position_m, MAX_POSITION_ERROR_M),
            ("normals", self.normal, MAX_RELATIVE_ERROR),
            ("visibility", self.visibility, MAX_RELATIVE_ERROR),
            ("covariances", self.covariance_relative, MAX_RELATIVE_ERROR),
        ]


@torch.no_grad()
def measure_parity(avatar: Avatar, checkpoint: Checkpoint, motion: Motion, rows: NDArray[np.int64]) -> ParityError:
    """Errors of ``avatar``, whose Gaussians are ``rows`` [N] of the checkpoint's, at each frame of ``motion``.

    A motion of more than ``MAX_FRAMES`` frames is sampled at that many, evenly.
    """
    outputs = ["skinning_weights", "means", "normals", "visibility", "covariances"]
    config, worst, distances = checkpoint.config.model, np.zeros(len(outputs)), []
    count = min(motion.frame_count, MAX_FRAMES)
    for frame in np.linspace(0, motion.frame_count - 1, count).round():
        time = frame / motion.fps
        pose = pose_input(motion, checkpoint.skeleton, time, config)
        posed = checkpoint.model(pose)
        window, velocity = motion_window(motion, time, poses=avatar.window_poses, seconds=avatar.window_seconds)
        exported = avatar.run((window, velocity, pose.bones.numpy()), outputs)
        reference = (posed.weights, posed.means, posed.normals, posed.visibility, posed.covariances)
        errors = [np.abs(a - b.numpy()[rows]) for a, b in zip(exported, reference)]
        errors[-1] /= posed.covariances.numpy()[rows][:, [0, 3, 5]].max(axis=1, keepdims=True)
        worst = np.maximum(worst, [float(error.max()) for error in errors])
        distances.append(np.linalg.norm(exported[1] - posed.means.numpy()[rows], axis=1))
    weights, position, *others = (float(error) for error in worst)
    return ParityError(count, weights, position, float(np.percentile(distances, 99)), *others)


def random_motion(skeleton: Skeleton, *, frames: int, seed: int) -> Motion:
    """A smooth random motion at 30 fps with joint angles up to about 1 rad and one rotation of the root."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None] / 30
    shape = (1, len(skeleton), 3)
    angles = 0.6 * np.sin(2 * np.pi * rng.uniform(0.3, 1.5, shape) * time + rng.uniform(0, 2 * np.pi, shape))
    angles[:, 0, 1] += 2 * np.pi * time[:, 0, 0] / time.max()
    translations = 0.3 * np.sin(time[:, 0] * np.array([1.0, 2.0, 1.5]))
    source = "random motion for the export check"
    return Motion(axis_angle_to_matrix(angles), translations, 30.0, skeleton.names, source)
