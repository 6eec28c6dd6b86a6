"""Our body fitted to joints that another program estimated, whatever body it estimated them on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Motion

from .fitting.figure import JOINTS, Figure, default_figure, known_figure
from .fitting.marks import JOINT_MARKS, Marks, marks_of
from .fitting.normal_equations import NormalEquations
from .fitting.pose_terms import PriorTerm, SmoothTerm
from .fitting.prior import pose_prior
from .fitting.start import bones_of_points, joint_rotations, local_rotations
from .fitting.state import TO_CAMERA, Layout, State
from .fitting.terms import BoneTerm, Lens, PositionTerm, SharedTerm, mark_points
from .lifted import Lifted
from .observations import BLAZEPOSE

Floats = NDArray[np.float64]

DEVIATION_M = 0.015
"""of a joint that another program estimated, beside a constant offset"""
JOINT_FREEDOM_M = 0.03
"""deviation of another body's idea of where a joint is"""
STEPS, CONVERGED = 20, 1e-4
_NEEDED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
_FOOT = {"left_foot": 31, "right_foot": 32}


@dataclass(frozen=True, eq=False)
class FittedJoints:
    """Our body in another program's poses.

    Attributes:
        motion: in the world of the joints; one pose a frame.
        body: at rest.
        residual_m: [T] mean distance of the given joints from the body's.
    """

    motion: Motion
    body: Body
    residual_m: Floats


def fit_joints(
    positions: Floats,
    names: Sequence[str],
    fps: float,
    *,
    lifted: Lifted | None = None,
    body: Body | Figure | None = None,
    height: float | None = None,
) -> FittedJoints:
    """Fit a body to joint positions of all frames at once.

    Args:
        positions: [T, N, 3] m, Y up; NaN where not known.
        names: N names of SMPL's joints or of ``BLAZEPOSE``; others are left out.
        lifted: bones' directions and rolls, if the program gives rotations too.
        body: as of ``fit.estimate``.
        height: m; by default the positions' own scale counts.

    Raises:
        InputError: positions that are not metres or lack hips, knees, ankles, shoulders, elbows or wrists.
    """
    points, pinned = _as_marks(np.asarray(positions, np.float64), list(names))
    figure = default_figure() if body is None else known_figure(body) if isinstance(body, Body) else body
    marks = marks_of(figure)
    count = len(points)
    marks = _with_joints(marks, figure, pinned)
    layout = Layout(figure, marks)
    known = np.asarray(np.isfinite(points).all(-1))
    if lifted is None:
        lifted = bones_of_points(np.nan_to_num(points[:, :33]) @ TO_CAMERA, known[:, :33], 100.0)
    rotations = local_rotations(TO_CAMERA @ joint_rotations(lifted), figure.body.skeleton)
    state = State(
        rotations, np.zeros((count, 3)), np.zeros(len(figure.names)), np.zeros_like(marks.places), 0.0, np.zeros(3)
    )
    now = mark_points(state, state.posed(figure), marks)
    gap = np.where(known[..., None], np.nan_to_num(points) - now, 0)
    state = replace(state, translations=gap.sum(1) / np.maximum(known.sum(1), 1)[:, None])
    times = np.arange(count) / fps
    skeleton = figure.body.skeleton
    terms = (
        PositionTerm(np.nan_to_num(points), np.where(known, DEVIATION_M, np.inf)),
        BoneTerm(lifted, weight=0.1),
        PriorTerm(pose_prior(), 0.02),
        SmoothTerm(times, np.full(len(skeleton), 20.0), np.full(len(skeleton), 100.0), 0.2),
        SharedTerm(Lens(np.zeros(2), 0.0, 1.0), 1 + 0.1 * count, height, scale_known=height is None),
    )
    state = _solve(state, figure, marks, layout, terms)
    posed = state.posed(figure)
    found = mark_points(state, posed, marks)
    gaps = np.where(known, np.linalg.norm(np.nan_to_num(points) - found, axis=-1), 0)
    residual = gaps.sum(1) / np.maximum(known.sum(1), 1)
    shaped = figure.shaped(state.shape)
    motion = Motion(state.rotations, state.translations, fps, skeleton.names)
    return FittedJoints(motion, shaped, residual)


def _as_marks(positions: Floats, names: list[str]) -> tuple[Floats, dict[int, str]]:
    """Positions [T, 33 + n, 3] as BLAZEPOSE's points, then those of SMPL's trunk; and the joints of the latter."""
    if positions.ndim != 3 or positions.shape[1:] != (len(names), 3) or not len(positions):
        expected = f"T × {len(names)} × 3, one of each name"
        raise InputError("joint positions", expected=expected, got="×".join(map(str, positions.shape)))
    columns = {name: k for k, name in enumerate(names)}
    missing = [s + n for n in _NEEDED for s in ("left_", "right_") if s + n not in columns]
    if missing:
        raise InputError(
            "joint positions", expected="SMPL's names of arms and legs", got=f"no {', '.join(missing[:4])}"
        )
    trunk = [name for name in JOINTS if name in columns and name not in BLAZEPOSE and name not in _FOOT]
    points = np.full((len(positions), len(BLAZEPOSE) + len(trunk), 3), np.nan)
    for mark, name in enumerate(BLAZEPOSE):
        if name in columns:
            points[:, mark] = positions[:, columns[name]]
    for k, name in enumerate(trunk):
        points[:, len(BLAZEPOSE) + k] = positions[:, columns[name]]
    for name, mark in _FOOT.items():
        if name in columns:
            points[:, mark] = positions[:, columns[name]]
    tall = np.nanmedian(np.nanmax(points[..., 1], 1) - np.nanmin(points[..., 1], 1))
    if not 0.2 < tall < 3:
        raise InputError("joint positions", expected="a person of 0.2 to 3 m", got=f"{tall:.3g} m")
    pinned = {len(BLAZEPOSE) + k: name for k, name in enumerate(trunk)}
    return points, pinned | {mark: name for name, mark in _FOOT.items() if name in columns}


def _with_joints(marks: Marks, figure: Figure, pinned: dict[int, str]) -> Marks:
    """``marks`` without hands' knuckles, with joints at the numbers of ``pinned``."""
    skeleton = figure.body.skeleton
    count = len(BLAZEPOSE) + sum(mark >= len(BLAZEPOSE) for mark in pinned)
    joints, places = np.zeros(count, np.int64), np.zeros((count, 3))
    basis, mirror = np.zeros((len(figure.names), count, 3)), np.arange(count)
    freedom = np.full(count, JOINT_FREEDOM_M)
    own = slice(0, len(BLAZEPOSE))
    joints[own], places[own], basis[:, own] = marks.joints[own], marks.places[own], marks.basis[:, own]
    mirror[own], freedom[own] = marks.mirror[own], np.maximum(marks.freedom_m[own], 0.02)
    numbers = {name: mark for mark, name in pinned.items()}
    for mark, name in pinned.items():
        joint = skeleton.names.index(name)
        joints[mark], places[mark] = joint, skeleton.rest_joints[joint]
        basis[:, mark] = figure.joint_basis[:, joint]
        other = name.replace("left", "*").replace("right", "left").replace("*", "right")
        mirror[mark] = numbers.get(other, mark)
    for mark in JOINT_MARKS:
        freedom[[mark, mark + 1]] = JOINT_FREEDOM_M
    return Marks(joints, places, basis, mirror, freedom)


def _solve(state: State, figure: Figure, marks: Marks, layout: Layout, terms: tuple) -> State:
    positions, bones, prior, smooth, shared = terms
    damping, cost = 1e-3, np.inf

    def evaluate(at: State, equations: NormalEquations | None = None) -> float:
        posed = at.posed(figure)
        total = positions(at, posed, figure, marks, layout, equations) + bones(at, posed, figure, layout, equations)
        total += prior(posed, layout, equations) + smooth(posed, layout, equations)
        return float(total + shared(at, figure, marks, layout, equations))

    for _ in range(STEPS):
        equations = NormalEquations(len(state.translations), layout.unknowns, layout.shared)
        before = evaluate(state, equations)
        for _ in range(4):
            local, common = equations.solve(damping)
            local[:, :-3] = np.clip(local[:, :-3], -0.5, 0.5)
            moved = layout.moved(state, local, common)
            cost = evaluate(moved)
            if cost <= before:
                state, damping = moved, max(0.3 * damping, 1e-6)
                break
            damping = 8 * damping + 1e-4
        if cost > before * (1 - CONVERGED):
            break
    return state
