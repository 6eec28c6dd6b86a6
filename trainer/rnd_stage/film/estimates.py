"""Simulated estimates of poses, normals and masks: ground truth with noise of a seed and a strength."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion

Floats = NDArray[np.float64]

# at strength 1
POSE_JITTER = np.radians(1.0)  # per axis and joint, independent from frame to frame
POSE_DRIFT = np.radians(2.5)  # per axis and joint, smooth over
DRIFT_SECONDS = 1.5
ROOT_JITTER, ROOT_DRIFT = 0.004, 0.015  # m
NORMAL_BLUR = 1.5  # pixels of an image of 512
NORMAL_TILT = 0.16  # length of the smooth tilt's vector: about 8° on average
NORMAL_ROTATION = np.radians(3.0)  # of all normals, sampled for every frame
MASK_WANDER = 2.5  # pixels of an image of 512: amplitude of the edge's displacement
MASK_GRAIN = 9.0  # pixels of an image of 512: its correlation length


def estimated_motion(
    motion: Motion, seed: int, strength: float = 1.0, *, jitter: float = 1.0, seconds: float = DRIFT_SECONDS
) -> Motion:
    """``motion`` with jitter and drift, smooth over ``seconds``, of every joint and of the root's position.

    ``jitter`` is a factor on the jitter alone; strength 0 changes nothing.
    """
    rng = np.random.default_rng((seed, 1))
    shape = (motion.frame_count, len(motion.joint_names), 3)
    sigma = seconds * motion.fps
    angles = jitter * POSE_JITTER * rng.normal(size=shape) + POSE_DRIFT * _wandering(rng, shape, sigma)
    shifts = jitter * ROOT_JITTER * rng.normal(size=(shape[0], 3)) + ROOT_DRIFT * _wandering(rng, (shape[0], 3), sigma)
    return replace(
        motion,
        rotations=motion.rotations @ axis_angle_to_matrix(strength * angles),
        translations=motion.translations + strength * shifts,
    )


def estimated_normals(normals: Floats, coverage: Floats, seed: int, strength: float = 1.0) -> Floats:
    """``normals`` [H, W, 3] (camera axes) blurred, smoothly tilted and rotated, as if by a network.

    Unit and facing the camera where ``coverage`` [H, W] is at least 5 %, zero elsewhere.
    """
    rng = np.random.default_rng((seed, 2))
    height, width = coverage.shape
    blur = max(strength * NORMAL_BLUR * height / 512, 1e-3)
    weight = cv2.GaussianBlur(coverage, (0, 0), blur)[..., None]
    smooth = cv2.GaussianBlur(normals * coverage[..., None], (0, 0), blur) / np.maximum(weight, 1e-3)
    tilt = cv2.resize(rng.normal(size=(6, 6, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
    rotation = axis_angle_to_matrix(strength * NORMAL_ROTATION * rng.normal(size=3) / np.sqrt(3))
    result = smooth @ rotation.T + strength * NORMAL_TILT * tilt
    result[..., 2] = np.minimum(result[..., 2], -0.02)
    result /= np.maximum(np.linalg.norm(result, axis=-1, keepdims=True), 1e-9)
    return result * (coverage >= 0.05)[..., None]


def estimated_mask(coverage: Floats, seed: int, strength: float = 1.0) -> Floats:
    """``coverage`` [H, W] with a hard, ragged edge, as if by a segmentation; strength 0 changes nothing."""
    if strength == 0:
        return coverage
    rng = np.random.default_rng((seed, 3))
    height, width = coverage.shape
    scale = height / 512
    inside = (coverage >= 0.5).astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    grain = max(MASK_GRAIN * scale, 0.5)
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), grain)
    noise *= strength * MASK_WANDER * scale / max(float(noise.std()), 1e-9)
    return np.clip(distance + noise + 0.5, 0, 1)


def _wandering(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Floats:
    """Smooth noise over the first axis, σ about 1."""
    margin = int(np.ceil(4 * sigma))
    noise = gaussian_filter1d(rng.normal(size=(shape[0] + 2 * margin, *shape[1:])), sigma, axis=0)
    return noise[margin:-margin] * np.sqrt(2 * np.sqrt(np.pi) * sigma)
