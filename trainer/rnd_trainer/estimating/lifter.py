"""Lifting: the landmarks of about one second of video to directions of bones in 3D, by a small temporal network."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError

from .lifted import JOINTS, Lifted
from .observations import TRUNK, Observations

Floats32 = NDArray[np.float32]

NETWORK = Path(__file__).with_name("lifter.onnx")
FPS = 30.0
"""rate of the network's frames"""
REACH = 21
"""frames before and after one frame that its result depends on, beside the smoothing of centre and size"""
POINTS = np.array([0, 7, 8, *range(11, 33)])
"""landmarks that the network sees: nose, ears, and all below"""
_LIMBS = [(11, 13), (13, 15), (23, 25), (25, 27), (27, 31), (15, 19)]
LIMBS = np.array([(a + side, b + side) for a, b in _LIMBS for side in (0, 1)])
"""pairs of landmarks whose direction is guessed from the length in the image"""
CHANNELS = len(POINTS) * 6 + len(LIMBS) * 6 + 2
"""inputs a frame: 2D, confidence and 3D of the points, directions of the limbs, distance, time to the nearest frame"""
_SMOOTH = 4  # frames on each side over which centre and size are averaged
_GAP = 0.5  # s; frames of the video farther apart than this are not interpolated as one motion


@dataclass(frozen=True, eq=False)
class Features:
    """Inputs of the network.

    Attributes:
        inputs: [B, T, CHANNELS].
        views: [B, T, 3, 3] rotations from camera axes to those of a camera that looks at the person's middle.
    """

    inputs: Floats32
    views: Floats32


def features(rays: Floats32, confidence: Floats32, hint_m: Floats32, gap_s: Floats32) -> Features:
    """Normalise landmarks to a camera that looks at the person's middle, and to the person's apparent size.

    Args:
        rays: [B, T, 33, 2] x/z and y/z in camera axes.
        confidence: [B, T, 33] 0…1.
        hint_m: [B, T, 33, 3] the landmark network's 3D, m.
        gap_s: [B, T] time to the nearest frame of the video, s.
    """
    seen = confidence[..., None] + 0.05
    torso = seen[:, :, TRUNK]
    middle = _smoothed((rays[:, :, TRUNK] * torso).sum(2) / torso.sum(2))
    views = looking_at(middle)
    rotated = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ np.swapaxes(views, -1, -2)
    flat = rotated[..., :2] / np.maximum(rotated[..., 2:], 0.05)
    metric, distance = _in_metres(np.asarray(flat, np.float32), seen, hint_m)
    bones = metric[:, :, LIMBS[:, 1]] - metric[:, :, LIMBS[:, 0]]
    hinted = hint_m[:, :, LIMBS[:, 1]] - hint_m[:, :, LIMBS[:, 0]]
    length = np.linalg.norm(hinted, axis=-1)
    depth = np.sqrt(np.maximum(_smoothed(length) ** 2 - (bones * bones).sum(-1), 0)) * np.sign(hinted[..., 2])
    guessed = np.concatenate([bones, depth[..., None]], -1)
    guessed /= np.maximum(np.linalg.norm(guessed, axis=-1, keepdims=True), 0.02)
    shape = flat.shape[:2]
    inputs = np.concatenate(
        [
            np.clip(2 * metric[:, :, POINTS], -4, 4).reshape(*shape, -1),
            confidence[:, :, POINTS],
            np.clip(2 * hint_m[:, :, POINTS], -4, 4).reshape(*shape, -1),
            (hinted / np.maximum(length[..., None], 0.02)).reshape(*shape, -1),
            guessed.reshape(*shape, -1),
            np.log(distance) - 1,
            np.minimum(10 * gap_s, 5)[..., None],
        ],
        -1,
    )
    return Features(inputs.astype(np.float32), views.astype(np.float32))


def _in_metres(flat: Floats32, seen: Floats32, hint_m: Floats32) -> tuple[Floats32, Floats32]:
    """2D positions [B, T, 33, 2] m from their mean, and the distance [B, T, 1] m, by the scale of ``hint_m``."""
    weight = seen / seen.sum(2, keepdims=True)
    flat = flat - (flat * weight).sum(2, keepdims=True)
    known = hint_m[..., :2] - (hint_m[..., :2] * weight).sum(2, keepdims=True)
    own = (weight * flat * flat).sum((2, 3))[..., None]
    both = (weight * flat * known).sum((2, 3))[..., None]
    distance = np.clip(_smoothed(both) / np.maximum(_smoothed(own), 1e-6), 0.3, 60).astype(np.float32)
    return flat * distance[..., None], distance


def _smoothed(values: Floats32) -> Floats32:
    """Means [B, T, n] over 2·_SMOOTH + 1 frames; the ends are repeated."""
    padded = np.pad(values, ((0, 0), (_SMOOTH + 1, _SMOOTH), (0, 0)), mode="edge").astype(np.float64)
    total = padded.cumsum(1)
    width = 2 * _SMOOTH + 1
    means: Floats32 = ((total[:, width:] - total[:, :-width]) / width).astype(np.float32)
    return means


def looking_at(middle: Floats32) -> Floats32:
    """Smallest rotations [..., 3, 3] that turn the rays ``middle`` [..., 2] onto the camera's axis."""
    axis = np.concatenate([middle, np.ones_like(middle[..., :1])], -1)
    x, y, z = np.moveaxis(axis / np.linalg.norm(axis, axis=-1, keepdims=True), -1, 0)
    k = 1 / (1 + z)
    rows = [[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]]
    return np.stack([np.stack(row, -1) for row in rows], -2).astype(np.float32)


@cache
def _session(path: Path) -> Any:
    import onnxruntime

    if not path.exists():
        raise InputError("lifter", expected="the network that the package ships", got="none", file=path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def lift(
    observations: Observations,
    focal_px: float,
    principal_px: tuple[float, float] | NDArray[np.floating],
    network: Path = NETWORK,
) -> Lifted:
    """Directions of the bones of the person in ``observations``, with their concentrations.

    Args:
        focal_px: focal length, pixels.
        principal_px: principal point, pixels; the image's centre is half its size.
        network: the ONNX file, by default the one that the package ships.

    Raises:
        InputError: fewer than two frames.
    """
    times, at = _network_times(observations)
    rays = (observations.keypoints_px - np.asarray(principal_px, np.float32)) / np.float32(focal_px)
    recorded = rays, observations.confidence, observations.keypoints_m
    rays, confidence, hint_m = (_resampled(values, times, at)[None] for values in recorded)
    gap = np.abs(times[:, None] - at[None]).min(0).astype(np.float32)
    inputs = features(rays, confidence, hint_m, gap[None])
    means, kappas = run(inputs.inputs, network)
    back = np.swapaxes(inputs.views, -1, -2)[:, :, None]
    vectors = (back @ means[..., None])[0, ..., 0]
    chosen = _resampled(np.concatenate([vectors, np.log(kappas[0])[..., None]], -1).astype(np.float32), at, times)
    unit = chosen[..., :3] / np.maximum(np.linalg.norm(chosen[..., :3], axis=-1, keepdims=True), 1e-6)
    kappa = np.exp(chosen[..., 3])
    bones = len(JOINTS) - 1
    return Lifted(unit[:, :bones], kappa[:, :bones], unit[:, bones:], kappa[:, bones:])


def run(inputs: Floats32, network: Path = NETWORK) -> tuple[Floats32, Floats32]:
    """Unit vectors [B, T, 42, 3] in the axes of ``Features.views`` and concentrations [B, T, 42]; ends are repeated."""
    padded = np.pad(inputs, ((0, 0), (REACH, REACH), (0, 0)), mode="edge")
    means, kappas = _session(network).run(None, {"features": padded})
    return means, kappas


def _network_times(observations: Observations) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds of the video's frames, and of the network's."""
    if len(observations) < 2:
        raise InputError("observations", expected="at least 2 frames", got=len(observations))
    times = (observations.frames - observations.frames[0]) / observations.fps
    return times, np.arange(int(np.ceil(times[-1] * FPS)) + 1) / FPS


def _resampled(values: Floats32, times: NDArray[np.float64], at: NDArray[np.float64]) -> Floats32:
    """``values`` [T, ...] given at ``times``, at other times: interpolated, or averaged where they are dense."""
    dense = np.median(np.diff(times)) / max(np.median(np.diff(at)) if len(at) > 1 else 1 / FPS, 1e-9)
    flat = values.reshape(len(values), -1)
    if dense < 0.75:  # a faster video: mean of the frames of each interval, weighted by their distance
        width = np.median(np.diff(at))
        weight = np.maximum(1 - np.abs(at[:, None] - times[None]) / width, 0)
        weight /= np.maximum(weight.sum(1, keepdims=True), 1e-9)
        return (weight @ flat).reshape(len(at), *values.shape[1:]).astype(np.float32)
    place = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    part = np.clip((at - times[place]) / np.maximum(times[place + 1] - times[place], 1e-9), 0, 1)[:, None]
    mixed = flat[place] * (1 - part) + flat[place + 1] * part
    return mixed.reshape(len(at), *values.shape[1:]).astype(np.float32)
