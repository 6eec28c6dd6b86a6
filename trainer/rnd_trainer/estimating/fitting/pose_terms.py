"""The terms of poses by themselves: prior, hinges, smoothness in time, stillness, ground, balance. See ``terms``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_trainer.estimating.observations import FEET

from .figure import JOINTS, Figure
from .kinematics import Posed, attached, point_derivative, shape_derivative
from .marks import Marks
from .normal_equations import NormalEquations
from .prior import Prior
from .state import Layout, State
from .terms import Lens, marks_by_shape, robust

Floats = NDArray[np.float64]

AROUND_SECONDS = 2.0
"""time over which a joint's usual rate is measured"""
STILL_DRIFT = 0.013
"""rad/√s, of a joint that keeps still"""
STILL_RATE = 0.3
"""rad/s; a joint that usually turns so fast drifts twice as far"""
COLLAR = 0.5
"""rotation of a collar to its arm's (Inman et al. 1944), which the lifter hardly sees"""

MASSES = {
    "pelvis": 0.112,
    "spine1": 0.08,
    "spine2": 0.08,
    "spine3": 0.16,
    "head": 0.07,
    "hip": 0.083,
    "knee": 0.082,
    "ankle": 0.026,
    "foot": 0.007,
    "shoulder": 0.011,
    "elbow": 0.025,
    "wrist": 0.014,
}
"""share of the body's mass at each joint: segments by their centres of mass (de Leva 1996)"""
REACH_M = 0.06
"""m above the ground at which a point of a foot is in the air"""
SWAY_M = 0.06
"""m, deviation of the centre of mass from the middle of the feet along each axis, beside that of the feet"""
LOW_PELVIS, HIGH_PELVIS = 0.70, 0.85
"""height of the pelvis over that in standing, below which nobody stands and above which one does"""


def right_jacobian_inverse(vectors: Floats) -> Floats:
    """d log(exp(v) exp(δ)) / dδ [..., 3, 3] at δ = 0."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    safe = np.maximum(angle, 1e-3)
    second = np.where(angle < 1e-3, 1 / 12, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe) + 1e-12))
    return np.eye(3) + 0.5 * cross + second * (cross @ cross)


@dataclass(frozen=True, eq=False)
class PriorTerm:
    """The pose prior, and knees and elbows that bend one way."""

    prior: Prior
    weight: float = 0.05
    limit_deviation: float = 0.08  # rad past straight

    def __call__(self, posed: Posed, layout: Layout, equations: NormalEquations | None) -> float:
        names = posed.skeleton.names
        order = [names.index(name) for name in JOINTS[1:]]
        columns = [int(np.flatnonzero(layout.active == k)[0]) for k in order]
        vectors = matrix_to_axis_angle(posed.rotations[:, order])  # [T, 21, 3]
        count = len(vectors)
        residual = (vectors.reshape(count, -1) - self.prior.mean) @ self.prior.whiten.T
        cost = self.weight * float((residual**2).sum())
        hinge, signs = self._hinges(vectors)
        cost += float((hinge**2).sum())
        if equations is not None:
            turn = right_jacobian_inverse(vectors)
            local = np.zeros((count, residual.shape[1], layout.unknowns))
            rows = np.zeros((count, hinge.shape[1], layout.unknowns))
            for j, column in enumerate(columns):
                here = slice(3 * column, 3 * column + 3)
                local[:, :, here] = self.prior.whiten[:, 3 * j : 3 * j + 3] @ turn[:, j]
            for row, (j, axis, sign) in enumerate(signs):
                here = slice(3 * columns[j], 3 * columns[j] + 3)
                active = (hinge[:, row] > 0)[:, None]
                rows[:, row, here] = active * sign / self.limit_deviation * turn[:, j, axis]
            equations.add(residual, np.full_like(residual, self.weight), local)
            equations.add(hinge, np.ones_like(hinge), rows)
        return cost

    def _hinges(self, vectors: Floats) -> tuple[Floats, list[tuple[int, int, float]]]:
        """Residuals [T, 4] of over-stretched hinges, and (joint, axis, sign that over-stretches)."""
        signs = [
            (JOINTS.index(name) - 1, axis, sign)
            for name, axis, sign in (
                ("left_knee", 0, -1.0),
                ("right_knee", 0, -1.0),
                ("left_elbow", 1, 1.0),
                ("right_elbow", 1, -1.0),
            )
        ]
        past = [np.maximum(sign * vectors[:, j, axis] - 0.05, 0) for j, axis, sign in signs]
        return np.stack(past, 1) / self.limit_deviation, signs


@dataclass(frozen=True, eq=False)
class SmoothTerm:
    """Accelerations of joints (m/s²) and of their local rotations (rad/s²) against those of people."""

    times: Floats
    joints: Floats  # [J] m/s², deviations along each axis
    rotations: Floats  # [J] rad/s²
    weight: float = 1.0
    limit: float = 4.0

    def __call__(self, posed: Posed, layout: Layout, equations: NormalEquations | None) -> float:
        if len(posed) < 3:
            return 0.0
        before, after = np.diff(self.times)[:-1], np.diff(self.times)[1:]
        first, last = 2 / (before * (before + after)), 2 / (after * (before + after))
        factors = np.stack([first, -first - last, last], 1)[:, :, None, None]  # [T − 2, 3, 1, 1]
        active = layout.active
        positions = posed.joints[:, active] / self.joints[active, None]
        count = len(positions) - 2
        chain = [positions[k : k + count] for k in range(3)]
        residual = factors[:, 0] * chain[0] + factors[:, 1] * chain[1] + factors[:, 2] * chain[2]
        cost, kept = robust((residual**2).sum(-1), self.limit)
        turned = posed.rotations[:, active]
        steps = _steps(turned)  # [T − 1, A, 3]
        span = np.diff(self.times)[:, None, None]
        middle = (0.5 * (before + after))[:, None, None]
        rates = steps / span
        spin = (rates[1:] - rates[:-1]) / middle / self.rotations[active, None]
        spin_cost, spin_kept = robust((spin**2).sum(-1), self.limit)
        if equations is not None:
            by = point_derivative(posed, posed.joints[:, active], active, active) / self.joints[active, None, None]
            by = by.reshape(len(by), -1, layout.unknowns)
            parts = [factors[:, k] * by[k : k + count] for k in range(3)]
            weight = self.weight * np.repeat(kept, 3, axis=1)
            equations.add_chain(residual.reshape(count, -1), weight, parts)
            self._add_spin(equations, steps, span, middle, spin, spin_kept, layout)
        return self.weight * (cost + spin_cost)

    def _add_spin(
        self,
        equations: NormalEquations,
        steps: Floats,
        span: Floats,
        middle: Floats,
        spin: Floats,
        kept: Floats,
        layout: Layout,
    ) -> None:
        forward, backward = right_jacobian_inverse(steps), -right_jacobian_inverse(-steps)  # by δ(t + 1), by δ(t)
        scale = 1 / middle / self.rotations[layout.active, None]
        early, late = 1 / span[:-1], 1 / span[1:]
        blocks = [
            -scale[..., None] * early[..., None] * backward[:-1],
            scale[..., None] * (late[..., None] * backward[1:] - early[..., None] * forward[:-1]),
            scale[..., None] * late[..., None] * forward[1:],
        ]
        parts = [_of_each_joint(block, layout.unknowns) for block in blocks]
        equations.add_chain(spin.reshape(len(spin), -1), self.weight * np.repeat(kept, 3, axis=1), parts)


@dataclass(frozen=True, eq=False)
class StillTerm:
    """Joints that hardly turn keep still, so that a pose held while the person turns round is seen from all sides.

    A random walk of each joint's local rotation, as wide as the lifter sees the joint move around that time; what
    turns faster is left alone, and so is the root.

    Attributes:
        steps: [T − 1, J] rad, deviation of each joint's rotation from one frame to the next.
    """

    steps: Floats
    weight: float = 1.0
    limit: float = 2.0  # in deviations

    @classmethod
    def of(cls, times: Floats, rotations: Floats, names: Sequence[str], weight: float) -> StillTerm:
        """The term of local rotations [T, J, 3, 3] of joints ``names`` at ``times``, s."""
        seconds = np.diff(times)
        rates = np.linalg.norm(_steps(rotations), axis=-1) / seconds[:, None]
        around = max(1, round(AROUND_SECONDS / float(np.median(seconds))))
        usual = median_filter(rates, (around, 1), mode="nearest")
        for side in ("left", "right"):
            collar, shoulder = names.index(f"{side}_collar"), names.index(f"{side}_shoulder")
            usual[:, collar] = np.maximum(usual[:, collar], COLLAR * usual[:, shoulder])
        drift = STILL_DRIFT * (1 + (usual / STILL_RATE) ** 3)
        return cls(drift * np.sqrt(seconds)[:, None], weight)

    def __call__(self, posed: Posed, layout: Layout, equations: NormalEquations | None) -> float:
        active = layout.active
        steps = _steps(posed.rotations[:, active])
        scale = ((active != 0) / self.steps[:, active])[..., None]
        residual = steps * scale
        cost, kept = robust((residual**2).sum(-1), self.limit)
        if equations is not None:
            backward, forward = -right_jacobian_inverse(-steps), right_jacobian_inverse(steps)  # by δ(t), by δ(t + 1)
            parts = [_of_each_joint(scale[..., None] * block, layout.unknowns) for block in (backward, forward)]
            weight = self.weight * np.repeat(kept, 3, axis=1)
            equations.add_chain(residual.reshape(len(residual), -1), weight, parts)
        return self.weight * cost


def _steps(rotations: Floats) -> Floats:
    """Rotation vectors [T − 1, J, 3] from each of ``rotations`` [T, J, 3, 3] to the next, about its own axes."""
    return matrix_to_axis_angle(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])


def _of_each_joint(blocks: Floats, unknowns: int) -> Floats:
    """Derivatives [T, A·3, unknowns] of which each joint has its own rows, from ``blocks`` [T, A, 3, 3]."""
    count, joints = blocks.shape[:2]
    whole = np.zeros((count, joints, 3, unknowns))
    for j in range(joints):
        whole[:, j, :, 3 * j : 3 * j + 3] = blocks[:, j]
    return whole.reshape(count, -1, unknowns)


@dataclass(frozen=True, eq=False)
class GroundTerm:
    """Feet stand on a plane, do not sink into it, and stay put where they stand."""

    times: Floats
    weight: float = 1.0  # of heights
    slide_weight: float = 1.0
    height_m: float = 0.025
    slip: float = 0.15  # m/s of a standing foot
    moving: float = 0.8  # m/s; a faster foot does not stand

    def __call__(
        self,
        state: State,
        posed: Posed,
        figure: Figure,
        marks: Marks,
        layout: Layout,
        equations: NormalEquations | None,
    ) -> float:
        soles, points = _soles(state, posed, marks)
        up = state.up
        heights = points @ up - state.ground[0]
        lowest = np.minimum(heights, REACH_M * 3)
        cost, kept = robust((lowest / self.height_m) ** 2, REACH_M / self.height_m)
        kept = np.where(heights < REACH_M * 3, kept, 0)
        below = np.where(heights < 0, 1.0, 0.0)
        sunk = np.minimum(heights, 0) / self.height_m
        cost += float((sunk**2).sum())
        standing = np.exp(-0.5 * np.maximum(heights, 0) ** 2 / REACH_M**2)
        span = np.diff(self.times)[:, None, None]
        slide = np.diff(points, axis=0) / span / self.slip
        weights = np.minimum(standing[1:], standing[:-1])
        squares = (slide**2).sum(-1)
        slide_kept = 1 / (1 + squares / (self.moving / self.slip) ** 2)
        slide_cost = float((weights * slide_kept * squares).sum())
        if equations is not None:
            local = point_derivative(posed, points, soles.joints, layout.active)
            height_by = np.einsum("i,tpid->tpd", up, local)
            shared = np.zeros((*heights.shape, layout.shared))
            shared[..., layout.shape] = np.einsum("i,tpik->tpk", up, marks_by_shape(posed, figure, soles))
            shared[..., layout.ground.start] = -1
            shared[..., layout.ground.start + 1 : layout.ground.stop] = up[1] * points @ _sideways(up).T
            scale = 1 / self.height_m
            weight = self.weight * (kept + below)
            equations.add(heights * scale, weight, height_by * scale, shared * scale)
            moved = (local / self.slip).reshape(len(local), -1, layout.unknowns)
            by = [-moved[:-1] / span, moved[1:] / span]
            pair = np.repeat(weights * slide_kept**2, 3, axis=1) * self.slide_weight
            equations.add_chain(slide.reshape(len(slide), -1), pair, by)
        return self.weight * cost + self.slide_weight * slide_cost


@dataclass(frozen=True, eq=False)
class BalanceTerm:
    """The centre of mass is above the feet of who stands upright; how the ground is tilted follows from that.

    It sways with every movement and is right on average. What is measured in ``of`` counts as constant.

    Attributes:
        shares: [T, P] of the points of the feet in the middle of the support; they sum to 1.
        inverse: [T] one over the deviation, m⁻¹.
        upright: [T] 1 for a person who stands, 0 for one who sits, lies or jumps.
    """

    figure: Figure
    marks: Marks
    shares: Floats
    inverse: Floats
    upright: Floats
    weight: float = 1.0
    limit: float = 3.0

    @classmethod
    def of(cls, figure: Figure, marks: Marks, state: State, posed: Posed, weight: float) -> BalanceTerm:
        """The term for the feet that ``state`` stands on."""
        soles, points = _soles(state, posed, marks)
        heights = points @ state.up - state.ground[0]
        low = np.maximum(heights.min(1), 0)
        shares = np.exp(-0.5 * np.maximum(heights - low[:, None], 0) ** 2 / REACH_M**2)
        shares /= shares.sum(1, keepdims=True)
        middle = np.einsum("tp,tpi->ti", shares, points)
        spread = (shares * ((points - middle[:, None]) ** 2).sum(-1)).sum(1)
        standing = posed.rest[0, 1] - soles.places[:, 1].min()
        pelvis = posed.joints[:, 0] @ state.up - state.ground[0] - low
        upright = np.clip((pelvis / standing - LOW_PELVIS) / (HIGH_PELVIS - LOW_PELVIS), 0, 1)
        upright *= np.exp(-0.5 * low**2 / REACH_M**2)
        return cls(figure, marks, shares, 1 / np.sqrt(SWAY_M**2 + spread / 2), upright, weight)

    def __call__(
        self, state: State, posed: Posed, layout: Layout, lens: Lens, equations: NormalEquations | None
    ) -> float:
        soles, points = _soles(state, posed, self.marks)
        masses = np.array([MASSES.get(name.split("_")[-1], 0.0) for name in posed.skeleton.names])
        heavy = np.flatnonzero(masses)
        masses = masses[heavy] / masses.sum()
        lever = masses @ posed.joints[:, heavy] - np.einsum("tp,tpi->ti", self.shares, points)  # [T, 3]
        up = state.up
        sideways = _sideways(up)
        aside = lever @ sideways.T  # [T, 2]
        residual = aside * self.inverse[:, None]
        squares = (residual**2).sum(1)
        kept = 1 / (1 + squares / self.limit**2)
        if equations is not None:
            by_mass = point_derivative(posed, posed.joints[:, heavy], heavy, layout.active)
            by_feet = point_derivative(posed, points, soles.joints, layout.active)
            local = np.einsum("p,tpid->tid", masses, by_mass) - np.einsum("tp,tpid->tid", self.shares, by_feet)
            shared = np.zeros((*residual.shape, layout.shared))
            by_shape = np.einsum("p,tpik->tik", masses, shape_derivative(posed, self.figure.joint_basis)[:, heavy])
            by_shape -= np.einsum("tp,tpik->tik", self.shares, marks_by_shape(posed, self.figure, soles))
            shared[..., layout.shape] = sideways @ by_shape
            over = (lever @ up)[:, None, None] * sideways[:, [0, 2]] + up[[0, 2]][:, None] * aside[:, None]
            shared[..., layout.ground.start + 1 : layout.ground.stop] = -up[1] * over
            inverse = self.inverse[:, None, None]
            weight = self.weight * np.repeat((self.upright * kept**2)[:, None], 2, axis=1)
            equations.add(residual, weight, sideways @ local * inverse, shared * inverse)
        return self.weight * float((self.upright * squares * kept).sum())


def _sideways(up: Floats) -> Floats:
    """X and Z without their part along ``up`` [2, 3]; times ``up[1]``, d up / d the ground's two slopes."""
    return np.eye(3)[[0, 2]] - np.outer(up[[0, 2]], up)


def _soles(state: State, posed: Posed, marks: Marks) -> tuple[Marks, Floats]:
    """The points of heels and toes, and where they are [T, P, 3]."""
    soles = _part(marks, np.array(FEET))
    return soles, attached(posed, soles.joints, soles.places + np.tensordot(state.shape, soles.basis, 1))


def _part(marks: Marks, chosen: NDArray[np.int64]) -> Marks:
    return Marks(
        marks.joints[chosen],
        marks.places[chosen],
        marks.basis[:, chosen],
        marks.mirror[chosen],
        marks.freedom_m[chosen],
    )
