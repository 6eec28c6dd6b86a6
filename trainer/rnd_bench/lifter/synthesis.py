"""Batches of the lifter: bodies in motion, seen by cameras with the landmark network's errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rnd_trainer.estimating.lifted import PARENTS, REST_DIRECTIONS, ROLL_AXES
from rnd_trainer.estimating.lifter import Features, features

from .errors import ErrorModel, landmarks, seen_with_errors
from .motions import FPS, Clips, Floats32, Generator, sampled
from .views import positions, sampled_cameras, sampled_offsets

_UP = np.array(PARENTS[1:])
_STRIDES, _CHANCES = (1, 2, 3, 6), (0.5, 0.38, 0.08, 0.04)


@dataclass(frozen=True, eq=False)
class Batch:
    """Windows of a video.

    Attributes:
        inputs: [B, T, CHANNELS].
        targets: [B, T, 42, 3] unit vectors in the views' axes: directions, then rolls.
        hint_m: [B, T, 33, 3] the landmark network's 3D.
        views: [B, T, 3, 3] from camera axes to the views'.
        lengths: [B, 21] m of the bones.
    """

    inputs: Floats32
    targets: Floats32
    hint_m: Floats32
    views: Floats32
    lengths: Floats32


def vectors_of(rotations: Floats32) -> Floats32:
    """Directions and rolls [..., 42, 3] of joints with rotations [..., 22, 3, 3]."""
    directions = (rotations[..., _UP, :, :] @ REST_DIRECTIONS.astype(np.float32)[..., None])[..., 0]
    rolls = (rotations[..., 1:, :, :] @ ROLL_AXES.astype(np.float32)[..., None])[..., 0]
    return np.concatenate([directions, rolls], -2)


def batch(clips: Clips, errors: ErrorModel, count: int, frames: int, rng: Generator, augment: bool = True) -> Batch:
    """``count`` random windows of ``frames`` frames of ``clips``."""
    rotations, roots = sampled(clips, count, frames, rng, augment)
    offsets = sampled_offsets(count, rng)
    joints = positions(rotations, roots, offsets)
    cameras = sampled_cameras(joints, rng)
    rotations = cameras.rotations[:, None, None] @ rotations
    points = landmarks(rotations, cameras.seen(joints), errors.offsets + rng.normal(0, 0.008, (count, 1, 33, 3)))
    points[..., 2] = np.maximum(points[..., 2], 0.3)
    rays, confidence, hint = seen_with_errors(points, errors, rng)
    gap = np.zeros((count, frames), np.float32)
    for b, stride in enumerate(rng.choice(_STRIDES, count, p=_CHANCES)):
        if stride > 1:
            for array in (rays, confidence, hint):
                array[b] = strided(array[b], stride)
            phase = np.arange(frames) % stride
            gap[b] = np.minimum(phase, stride - phase) / FPS
    seen = features(rays, confidence, hint, gap)
    return _batch(seen, rotations, hint, np.linalg.norm(offsets[:, 1:], axis=-1))


def _batch(seen: Features, rotations: Floats32, hint: Floats32, lengths: Floats32) -> Batch:
    targets = vectors_of(seen.views[:, :, None] @ rotations)
    return Batch(seen.inputs, targets, hint, seen.views, lengths)


def strided(values: Floats32, stride: int) -> Floats32:
    """``values`` [T, ...] of every ``stride``-th frame, between them by lines."""
    at = np.arange(len(values)) / stride
    first = np.minimum(at.astype(int), (len(values) - 1) // stride)
    after = np.minimum(first + 1, (len(values) - 1) // stride)
    part = (at - first).reshape(-1, *[1] * (values.ndim - 1)).clip(0, 1)
    known = values[::stride]
    mixed: Floats32 = (known[first] * (1 - part) + known[after] * part).astype(np.float32)
    return mixed
