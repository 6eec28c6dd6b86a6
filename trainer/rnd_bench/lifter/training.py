"""Training of the lifter on films of people."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import PARENTS, REST_DIRECTIONS, REST_OFFSETS, ROLL_AXES
from rnd_trainer.estimating.lifter import REACH, features
from rnd_trainer.estimating.observing.landmarks import MIRRORED

from .filming import Window
from .motions import FPS, MIRROR, Floats32, Generator
from .network import LifterNetwork, negative_log_likelihood

FRAMES = 40
"""of a sample, 30 a second"""
WINDOWS = 256
"""of a step"""
RATE, DECAY = 1.5e-3, 0.05
POSITIONS = 10.0
"""weight of the joints' mean distance in metres beside the likelihood"""
ROLLS = 0.5
"""weight of the rolls' likelihood"""
MEMORY = 0.998
"""of the exponential mean of the weights"""
NOISE = 0.02
"""deviation of noise on the inputs"""
VARIANTS = 8
"""of each window"""
_SPEEDS, _SHARES = (1, 2, 3), (0.8, 0.14, 0.06)  # filmed frames from one to the next
_ROLL = 6.0  # degrees, deviation of the camera's
_FLIP = np.array([-1, 1, 1], np.float32)
_SEED = 53
_CHUNK = 64  # windows that one process varies
_UP = np.array(PARENTS[1:])


@dataclass(frozen=True, eq=False)
class Samples:
    """Windows of 30 frames a second: inputs [B, T, CHANNELS] and unit vectors [B, T, 42, 3] in the views' axes."""

    inputs: NDArray[np.float16]
    targets: NDArray[np.float16]


def vectors_of(rotations: Floats32) -> Floats32:
    """Directions and rolls [..., 42, 3] of joints with rotations [..., 22, 3, 3]."""
    directions = (rotations[..., _UP, :, :] @ REST_DIRECTIONS.astype(np.float32)[..., None])[..., 0]
    rolls = (rotations[..., 1:, :, :] @ ROLL_AXES.astype(np.float32)[..., None])[..., 0]
    return np.concatenate([directions, rolls], -2)


def samples_of(windows: list[Window], seed: int, variants: int) -> Samples:
    """Variants of each window: mirrored, rolled, of another rate and a part of it, at random."""
    rng = np.random.default_rng(seed)
    rows = [_varied(window, rng) for window in windows for _ in range(variants)]
    rays, confidence, hint, gap, rotations = (np.stack(arrays) for arrays in zip(*rows))
    seen = features(rays, confidence, hint, gap)
    targets = vectors_of(seen.views[:, :, None] @ rotations)
    return Samples(seen.inputs.astype(np.float16), targets.astype(np.float16))


def _varied(window: Window, rng: Generator) -> tuple[Floats32, ...]:
    names = ("rays", "confidence", "hint_m", "rotations")
    speed = int(rng.choice(_SPEEDS, p=_SHARES))
    if rng.random() < 0.1:
        window = {name: array[::-1] if array.ndim else array for name, array in window.items()}
    rays, confidence, hint, rotations = (window[name][::speed] for name in names)
    if rng.random() < 0.5:
        rays, confidence, hint = (a[:, MIRRORED] for a in (rays, confidence, hint))
        rays, hint = rays * _FLIP[:2], hint * _FLIP
        rotations = _FLIP[:, None] * rotations[:, MIRROR] * _FLIP
    roll = axis_angle_to_matrix([0.0, 0.0, np.radians(rng.normal(0, _ROLL))]).astype(np.float32)
    rays, hint, rotations = rays @ roll[:2, :2].T, hint @ roll.T, roll @ rotations
    stride = int(window["step"]) * speed
    if int(window["step"]) == 1 and rng.random() < 0.15:
        stride *= 2  # of a person who moves at half the speed
    count = (len(rays) - 1) * stride + 1
    first = int(rng.integers(max(count - FRAMES, 0) + 1))
    at = np.minimum(first + np.arange(FRAMES), count - 1)
    shown = [between(array, at, stride) for array in (rays, confidence, hint)]
    gap = np.minimum(at % stride, -at % stride).astype(np.float32) / np.float32(FPS)
    return (*shown, gap, _nearest_rotation(between(rotations, at, stride)))


def between(values: Floats32, at: Any, stride: int) -> Floats32:
    """``values`` [F, ...] of every ``stride``-th frame at the frames ``at``, by lines."""
    low = np.minimum(at // stride, len(values) - 1)
    high = np.minimum(low + 1, len(values) - 1)
    part = ((at - low * stride) / stride).reshape(-1, *[1] * (values.ndim - 1)).astype(np.float32)
    return np.asarray(values[low] * (1 - part) + values[high] * part, np.float32)


def _nearest_rotation(matrices: Floats32) -> Floats32:
    """Rotations near [..., 3, 3], by Gram and Schmidt's columns."""
    x = matrices[..., 0] / np.maximum(np.linalg.norm(matrices[..., 0], axis=-1, keepdims=True), 1e-6)
    y = matrices[..., 1] - (matrices[..., 1] * x).sum(-1, keepdims=True) * x
    y /= np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-6)
    return np.stack([x, y, np.cross(x, y)], -1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Trained:
    """The network of least loss on the validation windows, and the curve: rows of step, loss, validation."""

    network: LifterNetwork
    curve: list[dict[str, float]]


def train(
    windows: list[Window],
    validation: list[Window],
    steps: int,
    device: torch.device,
    pool: Executor,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
    *,
    seconds: float = np.inf,
    batch: int = WINDOWS,
    width: int | None = None,
    every: int = 250,
) -> Trained:
    """Adam with a falling rate, until ``steps`` or ``seconds`` are over; the exponential mean of the weights counts."""
    start = time.monotonic()
    torch.manual_seed(_SEED)
    rng = np.random.default_rng(_SEED)
    network = (LifterNetwork() if width is None else LifterNetwork(width)).to(device)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(min(MEMORY, 1 - 10 / (steps + 10))))
    groups = [
        {"params": [p for p in network.parameters() if p.ndim > 1], "weight_decay": DECAY},
        {"params": [p for p in network.parameters() if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(groups, lr=RATE, betas=(0.9, 0.98))
    known = _samples(validation, 2, device, pool)
    data = _samples(windows, VARIANTS, device, pool)
    curve: list[dict[str, float]] = []
    best, least = copy.deepcopy(network), np.inf
    half = device.type == "cuda"
    spent = time.monotonic() - start
    for step in range(steps):
        done = max(step / steps, (time.monotonic() - start - spent) / max(seconds - spent, 1e-3))
        last = done >= 1 or step == steps - 1
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 300) * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * min(done, 1))))
        chosen = torch.from_numpy(rng.integers(len(data[0]), size=batch)).to(device)
        inputs, targets = data[0][chosen].float(), data[1][chosen].float()
        inputs = inputs + NOISE * torch.randn_like(inputs)
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            loss = loss_of(network, inputs, targets)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        average.update_parameters(network)
        if step % every == every - 1 or last:
            value, degrees = _validated(_inner(average), *known)
            curve.append({"step": step + 1, "loss": float(loss.detach()), "validation": value, "limbs_deg": degrees})
            on_step(step + 1, value)
            if value < least:
                best, least = copy.deepcopy(_inner(average)), value
        if last:
            break
    return Trained(best.eval().cpu(), curve)


def _inner(average: AveragedModel) -> LifterNetwork:
    assert isinstance(average.module, LifterNetwork)
    return average.module


def _samples(windows: list[Window], variants: int, device: torch.device, pool: Executor) -> tuple[Tensor, Tensor]:
    """Inputs and targets, in half precision."""
    parts = [
        pool.submit(samples_of, windows[start : start + _CHUNK], start, variants)
        for start in range(0, len(windows), _CHUNK)
    ]
    made = [part.result() for part in parts]
    inputs, targets = (np.concatenate([getattr(one, name) for one in made]) for name in ("inputs", "targets"))
    return torch.from_numpy(inputs).to(device), torch.from_numpy(targets).to(device)


def padded(inputs: Tensor) -> Tensor:
    """Inputs [B, T, n] with their first and last frames repeated ``REACH`` times."""
    return F.pad(inputs.mT, (REACH, REACH), mode="replicate").mT


def loss_of(network: LifterNetwork, inputs: Tensor, target: Tensor) -> Tensor:
    """Mean over frames of the likelihoods' means and of the distance of the joints."""
    unit, kappa = network(padded(inputs))
    each = negative_log_likelihood(unit, kappa, target).mean((0, 1))
    apart = (rest_joints(unit) - rest_joints(target)).norm(dim=-1).mean()
    return each[:21].mean() + ROLLS * each[21:].mean() + POSITIONS * apart


@torch.no_grad()
def _validated(network: LifterNetwork, inputs: Tensor, targets: Tensor) -> tuple[float, float]:
    """Loss, and mean angle of arms' and legs' directions in degrees."""
    network.eval()
    losses, angles = [], []
    for own, true in zip(inputs.float().split(512), targets.float().split(512)):
        losses.append(float(loss_of(network, own, true)) * len(own))
        unit, _ = network(padded(own))
        cosine = (unit * true).sum(-1)[..., [3, 4, 6, 7, 17, 18, 19, 20]].clamp(-1, 1)
        angles.append(float(torch.rad2deg(cosine.acos()).mean()) * len(own))
    network.train()
    return sum(losses) / len(inputs), sum(angles) / len(inputs)


def rest_joints(vectors: Tensor) -> Tensor:
    """Joints [..., 22, 3] of the mean body's bones with the first 21 of ``vectors`` [..., 42, 3], from the pelvis."""
    lengths = torch.tensor(REST_OFFSETS[1:]).norm(dim=-1).to(vectors)
    joints = [torch.zeros_like(vectors[..., 0, :])]
    for bone, parent in enumerate(PARENTS[1:]):
        joints.append(joints[parent] + lengths[bone] * vectors[..., bone, :])
    return torch.stack(joints, -2)
