"""Where the landmark network sees the points of a body: offsets from the joints, and a model of its errors.

The errors of a frame are jointly Gaussian given the pose: a mean that is linear in the true points and in the direction
that the person faces, a covariance over all points, part of it constant in a window and the rest correlated in time.
Points of low confidence err more. All is fitted to a rendered person (``captured``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.lifter import looking_at
from rnd_trainer.estimating.observations import BLAZEPOSE

from .motions import Floats32, Generator

Floats = NDArray[np.float64]
Window = dict[str, Floats32]

POINTS = len(BLAZEPOSE)
SWAPPED = np.array(
    [BLAZEPOSE.index("_".join({"left": "right", "right": "left"}.get(w, w) for w in n.split("_"))) for n in BLAZEPOSE]
)
FACTORS = 40
"""components of the covariance; what is beside them is independent between values"""
FOLDS = 4
"""of the windows, for errors beside the mean"""
_HIPS = [BLAZEPOSE.index("left_hip"), BLAZEPOSE.index("right_hip")]
_SHOULDERS = [BLAZEPOSE.index("left_shoulder"), BLAZEPOSE.index("right_shoulder")]
_PLAIN = np.array([-1, 1, 1], np.float32)


def _attached() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The joint at which each point is, and the joint whose rotation carries its offset."""
    at, turned = [], []
    for name in BLAZEPOSE:
        side, _, part = name.partition("_")
        joint = {"shoulder": "shoulder", "elbow": "elbow", "hip": "hip", "knee": "knee", "ankle": "ankle"}.get(part)
        if side not in ("left", "right") or part.startswith(("eye", "ear")):
            pair = ("head", "head")
        elif joint:
            carrier = {
                "shoulder": f"{side}_collar",
                "elbow": f"{side}_shoulder",
                "hip": "pelvis",
                "knee": f"{side}_hip",
            }
            pair = (f"{side}_{joint}", carrier.get(part, f"{side}_knee"))
        elif part in ("heel", "foot_index"):
            pair = (f"{side}_ankle", f"{side}_ankle")
        else:
            pair = (f"{side}_wrist", f"{side}_elbow" if part == "wrist" else f"{side}_wrist")
        at.append(JOINTS.index(pair[0]))
        turned.append(JOINTS.index(pair[1]))
    return np.array(at), np.array(turned)


AT, CARRIER = _attached()


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """The 198 values of a frame are 2D errors (66, m at the hips' depth), 3D errors (99, m), logits of confidence (33).

    Attributes:
        offsets: [33, 3] m of the points from their joints, in the T-pose's axes, of a body of mean height.
        mean: [P, 198] of the values, by ``_predictors``.
        factors: [198, FACTORS] and rest: [198]: standard deviations; 2D and 3D of a point of full confidence.
        constant: [198] share of the variance that is constant in a window.
        memory: [198] correlation of the other share over 1/30 s.
        growth: [33] by which log error grows as the confidence falls from one to zero.
    """

    offsets: Floats
    mean: Floats
    factors: Floats
    rest: Floats
    constant: Floats
    memory: Floats
    growth: Floats


def landmarks(rotations: Floats32, joints: Floats32, offsets: Floats) -> Floats32:
    """The true points [..., 33, 3] of joints [..., 22, 3] with rotations [..., 22, 3, 3]."""
    scale = np.linalg.norm(joints[..., 7, :] - joints[..., 4, :], axis=-1)[..., None, None] / 0.419
    moved = (rotations[..., CARRIER, :, :] @ offsets.astype(np.float32)[..., None])[..., 0]
    points: Floats32 = joints[..., AT, :] + scale.astype(np.float32) * moved
    return points


def fit_offsets(windows: list[Window]) -> Floats:
    """Offsets [33, 3] that explain the 2D points best; left and right are mirror images."""
    seen, joints, rotations, sure = (
        np.concatenate([w[name] for w in windows]).astype(np.float64)
        for name in ("rays", "joints", "rotations", "confidence")
    )
    scale = np.linalg.norm(joints[:, 7] - joints[:, 4], axis=-1) / 0.419
    offsets = np.zeros((POINTS, 3))
    for point in range(POINTS):
        rows, sides = [], []
        for k, sign in {
            int(point): np.ones(3),
            int(SWAPPED[point]): _PLAIN if SWAPPED[point] != point else np.ones(3),
        }.items():
            base, turn = joints[:, AT[k]], rotations[:, CARRIER[k]] * sign * scale[:, None, None]
            for axis in (0, 1):
                ray = seen[:, k, axis]
                rows.append((turn[:, axis] - ray[:, None] * turn[:, 2]) * np.sqrt(sure[:, k])[:, None])
                sides.append((ray * base[:, 2] - base[:, axis]) * np.sqrt(sure[:, k]))
        a, b = np.concatenate(rows), np.concatenate(sides)
        weight, best = np.ones(len(b)), np.zeros(3)
        for _ in range(10):  # Geman-McClure's weights, 5 cm
            normal = (a * weight[:, None]).T @ a + 1e-3 * len(b) * np.eye(3)
            best = np.linalg.solve(normal, (a * weight[:, None]).T @ b)
            weight = 1 / (1 + ((a @ best - b) / 0.05) ** 2) ** 2
        offsets[point] = best
    return offsets


def _predictors(points: Floats32) -> Floats:
    """[..., P] of true points [..., 33, 3] in a view on the hips: their positions, and the direction faced."""
    middle = points[..., _HIPS, :].mean(-2, keepdims=True)
    across = (points[..., [_HIPS[0], _SHOULDERS[0]], :] - points[..., [_HIPS[1], _SHOULDERS[1]], :]).sum(-2)
    angle = np.arctan2(across[..., 2], across[..., 0])
    waves = [f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)]
    flat = (points - middle).reshape(*points.shape[:-2], -1)
    return np.concatenate([flat, np.stack([np.ones_like(angle), *waves], -1) * 0.5], -1).astype(np.float64)


def viewed(points: Floats32) -> tuple[Floats32, Floats32]:
    """Points [..., 33, 3] in a view whose axis goes through the middle of the hips, and the view [..., 3, 3]."""
    middle = points[..., _HIPS, :].mean(-2)
    view = looking_at(middle[..., :2] / middle[..., 2:])
    return points @ np.swapaxes(view, -1, -2), view


def fit_errors(windows: list[Window], ridge: float = 0.1) -> ErrorModel:
    """Fit the model to windows of rendered people (``captured``), each also mirrored."""
    offsets = fit_offsets(windows)
    predictors, values = [], []
    for window in windows:
        points, view = viewed(landmarks(window["rotations"], window["joints"], offsets))
        rays = np.concatenate([window["rays"], np.ones_like(window["rays"][..., :1])], -1) @ np.swapaxes(view, -1, -2)
        middle = points[:, _HIPS].mean(1, keepdims=True)
        flat = (rays[..., :2] / rays[..., 2:] - points[..., :2] / points[..., 2:]) * middle[..., 2:]
        deep = window["hint_m"] - (points - middle)
        sure = np.clip(window["confidence"], 0.003, 0.9995)
        logit = np.log(sure / (1 - sure))
        for mirrored in (False, True):
            if mirrored:
                points, flat, deep = (x[:, SWAPPED] * _PLAIN[: x.shape[-1]] for x in (points, flat, deep))
                logit = logit[:, SWAPPED]
            predictors.append(_predictors(points))
            values.append(np.concatenate([flat.reshape(len(flat), -1), deep.reshape(len(flat), -1), logit], -1))
    x, y = np.concatenate(predictors), np.concatenate(values)
    frames = np.array([len(p) for p in predictors])
    mean = _robust_ridge(x, y, ridge)
    fold = np.repeat(np.arange(len(frames)) // 2 % FOLDS, frames)  # a window and its mirror image together
    residual = np.empty_like(y)
    for k in range(FOLDS):  # of frames that the mean has not seen
        residual[fold == k] = y[fold == k] - x[fold == k] @ _robust_ridge(x[fold != k], y[fold != k], ridge)
    chance = 1 / (1 + np.exp(-y[:, 165:]))
    growth = _growths(residual, chance)
    residual[:, :165] /= np.exp(_amplitude(growth, chance))
    limit = 3.5 * np.sqrt(np.median(residual**2, 0) / 0.455)
    residual = np.clip(residual, -limit, limit)
    covariance = residual.T @ residual / len(residual)
    power, axes = np.linalg.eigh(covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2))
    factors = axes[:, -FACTORS:] * np.sqrt(power[-FACTORS:]) * np.sqrt(np.diag(covariance))[:, None]
    rest = np.sqrt(np.maximum(np.diag(covariance) - (factors**2).sum(1), 0))
    constant, memory = _times(np.split(residual, np.cumsum(frames)[:-1]))
    return ErrorModel(offsets, mean, factors, rest, constant, memory, growth)


def _robust_ridge(x: Floats, y: Floats, ridge: float) -> Floats:
    """Coefficients [P, V]: ridge regression, then once more without the frames that it explains worst."""
    weight = np.ones_like(y)
    mean = np.zeros((x.shape[1], y.shape[1]))
    for _ in range(2):
        for value in range(y.shape[1]):
            weighted = x * weight[:, value : value + 1]
            normal = weighted.T @ x + ridge * len(x) * np.eye(x.shape[1])
            mean[:, value] = np.linalg.solve(normal, weighted.T @ y[:, value])
        residual = y - x @ mean
        scale = 2.5 * np.sqrt(np.median(residual**2, 0) / 0.455)
        weight = 1 / (1 + (residual / scale) ** 2)
    return mean


def _growths(residual: Floats, chance: Floats) -> Floats:
    """Slopes [33] of log error over lost confidence, each drawn to their mean."""
    flat = np.linalg.norm(residual[:, :66].reshape(len(residual), POINTS, 2), axis=-1)
    log, lost = np.log(flat + 1e-3), 1 - chance
    shared = np.polyfit(lost.ravel(), log.ravel(), 1)[0]
    slopes = np.empty(POINTS)
    for k in range(POINTS):
        centred = lost[:, k] - lost[:, k].mean()
        slopes[k] = (centred @ (log[:, k] - log[:, k].mean()) + 20 * shared) / (centred @ centred + 20)
    return np.clip(slopes, 0, 3)


def _amplitude(growth: Floats, chance: Floats) -> Floats:
    """Logarithms [..., 165] of what errors are multiplied by."""
    log = growth * (1 - chance)
    return np.concatenate([np.repeat(log, 2, -1), np.repeat(log, 3, -1)], -1)


def _times(parts: list[Floats]) -> tuple[Floats, Floats]:
    """Share of the variance [198] that is constant in a window, and the rest's correlation over 1/30 s."""
    means = np.stack([part.mean(0) for part in parts])
    within = [part - part.mean(0) for part in parts]
    total = np.mean([(part**2).mean(0) for part in parts], 0) + 1e-12
    constant = np.clip((means**2).mean(0) / total, 0.05, 0.95)
    lagged = np.mean([(part[1:] * part[:-1]).mean(0) for part in within], 0)
    variance = np.mean([(part**2).mean(0) for part in within], 0) + 1e-12
    return constant, np.sqrt(
        np.clip(lagged / variance + 0.1, 0.05, 0.97)
    )  # frames are 1/15 s apart; short windows bias it


def seen_with_errors(points: Floats32, model: ErrorModel, rng: Generator) -> tuple[Floats32, Floats32, Floats32]:
    """What the landmark network might see of true points [B, T, 33, 3] in camera axes, 30 frames a second.

    Returns:
        rays [B, T, 33, 2], confidence [B, T, 33] and the network's 3D [B, T, 33, 3] m.
    """
    count, frames = points.shape[:2]
    ahead, view = viewed(points)
    middle = ahead[:, :, _HIPS].mean(2, keepdims=True)
    error = _noise(count, frames, model, rng)
    error *= np.exp(rng.normal(0, 0.4, (count, 1, 1))).astype(np.float32)  # some videos are worse
    mean = _predictors(ahead).astype(np.float32) @ model.mean.astype(np.float32)
    error += mean * rng.uniform(0.4, 1.2, (count, 1, 1)).astype(np.float32)
    chance = 1 / (1 + np.exp(-error[..., 165:]))
    error[..., :165] *= np.exp(_amplitude(model.growth, chance))
    _events(error, chance, rng)
    flat = ahead[..., :2] / ahead[..., 2:] + error[..., :66].reshape(count, frames, POINTS, 2) / middle[..., 2:]
    hint = ahead - middle + error[..., 66:165].reshape(count, frames, POINTS, 3)
    _swap(flat, hint, chance, rng)
    ends = np.concatenate([flat, np.ones_like(flat[..., :1])], -1) @ view
    rays = ends[..., :2] / np.maximum(ends[..., 2:], 0.05)
    return rays.astype(np.float32), chance.astype(np.float32), hint.astype(np.float32)


def _noise(count: int, frames: int, model: ErrorModel, rng: Generator) -> Floats32:
    """Zero-mean values [B, T, 198], correlated over points and time."""
    factors, rest = model.factors.astype(np.float32).T, model.rest.astype(np.float32)
    constant, memory = model.constant.astype(np.float32), np.round(model.memory / 0.05) * 0.05

    def white(length: int) -> Floats32:
        shared = rng.standard_normal((count, length, FACTORS), np.float32) @ factors
        return shared + rng.standard_normal((count, length, len(rest)), np.float32) * rest

    moving = white(frames + 8)
    for value in np.unique(memory):
        chosen, keep = memory == value, np.float32(value)
        gain = np.sqrt(1 - keep**2)
        moving[..., chosen] = lfilter(np.stack([gain]), np.array([1, -keep], np.float32), moving[..., chosen], axis=1)
    noise = np.sqrt(constant) * white(1) + np.sqrt(1 - constant) * moving[:, 8:]
    return np.asarray(noise, np.float32)


def _events(error: NDArray[Any], chance: NDArray[Any], rng: Generator) -> None:
    """Limbs that are hidden or mistaken for a while."""
    count, frames = error.shape[:2]
    groups = [
        [15, 17, 19, 21],
        [16, 18, 20, 22],
        [13, 15, 17, 19, 21],
        [14, 16, 18, 20, 22],
        [27, 29, 31],
        [28, 30, 32],
    ]
    hidden = np.flatnonzero(rng.random(count) < 0.25)
    chosen = np.asarray(rng.integers(0, len(groups), count))
    for b, group in zip(hidden, chosen):
        start, length = rng.integers(frames), rng.integers(3, 20)
        part, members = slice(start, start + length), groups[group]
        shift = rng.normal(0, 0.08, 3)
        for k in members:
            error[b, part, 2 * k : 2 * k + 2] += shift[:2] + rng.normal(0, 0.02, 2)
            error[b, part, 66 + 3 * k : 69 + 3 * k] += shift * [1, 1, 2]
        chance[b, part, members] *= rng.uniform(0.1, 1.0)


def _swap(flat: NDArray[Any], hint: NDArray[Any], chance: NDArray[Any], rng: Generator) -> None:
    """Left and right that are mistaken for each other for some frames: legs, wrists or all."""
    count, frames = flat.shape[:2]
    kinds = [list(range(25, 33)), [15, 16, 17, 18, 19, 20, 21, 22], list(range(POINTS))]
    for b, kind in zip(
        np.flatnonzero(rng.random(count) < 0.08), rng.choice(np.arange(3), count, p=[0.5, 0.35, 0.15]).tolist()
    ):
        start = rng.integers(frames)
        part, members = slice(start, start + rng.integers(2, 10)), np.array(kinds[kind])
        for array in (flat, hint, chance):
            array[b, part, members] = array[b, part, SWAPPED[members]]
