"""Figures of the lifter: angles, joints and calibration, beside the landmark network's own 3D."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.lifted import JOINTS, PARENTS
from rnd_trainer.estimating.lifter import Features, features, run
from rnd_trainer.estimating.observations import BLAZEPOSE

from .filming import Window
from .motions import FPS, Floats32
from .training import between, vectors_of

Floats = NDArray[np.float64]

BODY = tuple(
    f"{side}_{part}" for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
"""joints of the distances"""
LIMBS = tuple(n for n in JOINTS if n.endswith(("knee", "ankle", "elbow", "wrist")))
"""ends of the bones whose angles the landmark network's 3D has too"""
_OURS = [JOINTS.index(n) for n in BODY]
_THEIRS = [BLAZEPOSE.index(n) for n in BODY]
_BINS = 10  # of predicted deviation


@dataclass(frozen=True, eq=False)
class Lifts:
    """Results beside the truth, over F frames, all in one frame's axes.

    Attributes:
        unit, kappa: [F, 42, 3] and [F, 42] of the lifter.
        target: [F, 42, 3].
        hint_m: [F, 33, 3] the landmark network's 3D.
        lengths: [F, 21] m of the bones.
    """

    unit: Floats32
    kappa: Floats32
    target: Floats32
    hint_m: Floats32
    lengths: Floats32


def of_windows(windows: list[Window], network: Path) -> Lifts:
    """Lifts of what the landmark network saw, in the frames seen."""
    parts = []
    for window in windows:
        step = int(window["step"])
        unit, kappa, seen = _lifted(window, network, step)
        target = vectors_of(seen.views[0, ::step, None] @ window["rotations"])
        bones = window["joints"][:, 1:] - window["joints"][:, PARENTS[1:]]
        parts.append([unit, kappa, target, window["hint_m"], np.linalg.norm(bones, axis=-1)])
    return Lifts(*(np.concatenate(arrays) for arrays in zip(*parts)))


def _lifted(window: Window, network: Path, step: int) -> tuple[Floats32, Floats32, Features]:
    """Unit vectors and concentrations of the frames of a window."""
    at = np.arange((len(window["rays"]) - 1) * step + 1)
    rays, confidence, hint = (between(window[name], at, step)[None] for name in ("rays", "confidence", "hint_m"))
    gap = np.minimum(at % step, -at % step)[None] / FPS
    seen = features(rays, confidence, hint, gap.astype(np.float32))
    unit, kappa = run(seen.inputs, network)
    return unit[0, ::step], kappa[0, ::step], seen


def figures(lifts: Lifts) -> dict[str, Any]:
    """Mean angles in degrees, distances of joints in mm, and calibration, over all frames."""
    angle = angles(lifts.unit, lifts.target)
    hint_angle = {n: angles(_hint_bone(lifts.hint_m, n), lifts.target[:, JOINTS.index(n) - 1]) for n in LIMBS}
    limbs = [JOINTS.index(n) - 1 for n in LIMBS]
    truth = placed(lifts.target, lifts.lengths)[:, _OURS]
    ours, theirs = placed(lifts.unit, lifts.lengths)[:, _OURS], lifts.hint_m[:, _THEIRS].astype(np.float64)
    return {
        "frames": len(angle),
        "limbs_deg": float(angle[:, limbs].mean()),
        "limbs_deg_landmarks": float(np.mean([a.mean() for a in hint_angle.values()])),
        "directions_deg": float(angle[:, :21].mean()),
        "rolls_deg": float(angle[:, 21:].mean()),
        "root_relative_mm": 1e3 * root_relative(ours, truth),
        "root_relative_mm_landmarks": 1e3 * root_relative(theirs, truth, scaled=True),
        "pa_mm": 1e3 * float(procrustes(ours, truth).mean()),
        "pa_mm_landmarks": 1e3 * float(procrustes(theirs, truth).mean()),
        "bones_deg": {n: float(a) for n, a in zip(JOINTS[1:], angle[:, :21].mean(0))},
        "roll_deg": {n: float(a) for n, a in zip(JOINTS[1:], angle[:, 21:].mean(0))},
        "bones_deg_landmarks": {n: float(a.mean()) for n, a in hint_angle.items()},
        "calibration": calibration(lifts),
    }


def angles(a: NDArray[np.floating], b: NDArray[np.floating]) -> Floats:
    """Degrees between unit vectors [..., 3]."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, (a * b).sum(-1)))


def _hint_bone(hint: Floats32, name: str) -> Floats32:
    start, end = (BLAZEPOSE.index(n) for n in (JOINTS[PARENTS[JOINTS.index(name)]], name))
    bone = hint[:, end] - hint[:, start]
    return bone / np.maximum(np.linalg.norm(bone, axis=-1, keepdims=True), 1e-9)


def placed(vectors: Floats32, lengths: Floats32) -> Floats:
    """Joints [F, 22, 3] m from the pelvis."""
    joints = np.zeros((len(vectors), len(JOINTS), 3))
    for bone, parent in enumerate(PARENTS[1:]):
        joints[:, bone + 1] = joints[:, parent] + vectors[:, bone] * lengths[:, bone, None]
    return joints


def root_relative(joints: Floats, truth: Floats, scaled: bool = False) -> float:
    """Mean distance from the middle of the hips; with ``scaled``, by the one scale that fits all frames best."""
    hips = [BODY.index("left_hip"), BODY.index("right_hip")]
    a, b = (x - x[:, hips].mean(1, keepdims=True) for x in (joints, truth))
    scale = (a * b).sum() / (a * a).sum() if scaled else 1.0
    return float(np.linalg.norm(scale * a - b, axis=-1).mean())


def procrustes(joints: Floats, truth: Floats) -> Floats:
    """Mean distances [F] after the best similarity of each frame."""
    a, b = joints - joints.mean(1, keepdims=True), truth - truth.mean(1, keepdims=True)
    u, s, v = np.linalg.svd(np.swapaxes(a, 1, 2) @ b)
    sign = np.ones_like(s)
    sign[:, -1] = np.sign(np.linalg.det(u @ v))
    scale = (s * sign).sum(1) / (a * a).sum((1, 2))
    moved = scale[:, None, None] * (a @ ((u * sign[:, None]) @ v))
    return np.linalg.norm(moved - b, axis=-1).mean(1)


def calibration(lifts: Lifts) -> list[dict[str, float]]:
    """Predicted and actual deviation of directions, degrees a tangent axis, by deciles of the predicted one."""
    predicted = np.degrees(1 / np.sqrt(lifts.kappa[:, :21])).ravel()
    actual = angles(lifts.unit[:, :21], lifts.target[:, :21]).ravel()
    order = np.argsort(predicted)
    rows = []
    for part in np.array_split(order, _BINS):
        rms = np.sqrt((actual[part] ** 2).mean() / 2)
        rows.append({"predicted_deg": float(np.sqrt((predicted[part] ** 2).mean())), "actual_deg": float(rms)})
    return rows


def rows_of(lifts: Iterator[tuple[str, Lifts]]) -> list[dict[str, Any]]:
    """One row of figures for each named set."""
    return [{"set": name, **figures(one)} for name, one in lifts]
