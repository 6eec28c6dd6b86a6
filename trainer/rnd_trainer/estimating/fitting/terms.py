"""The terms of the fit: each returns its robust cost and adds its derivatives to the normal equations.

Residuals are in deviations, so that costs of all terms add. ``Geman-McClure``: ρ(r²) = r² / (1 + r²/c²).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_trainer.estimating.lifted import PARENTS, REST_DIRECTIONS, ROLL_AXES, Lifted

from .figure import JOINTS, Figure
from .kinematics import Posed, attached, direction_derivative, point_derivative, shape_derivative
from .marks import Marks
from .normal_equations import NormalEquations
from .prior import Prior
from .state import TO_CAMERA, Layout, State

Floats = NDArray[np.float64]

LIMBS = tuple(f"{side}_{name}" for side in ("left", "right") for name in ("knee", "ankle", "elbow", "wrist"))
HEEL_TOE = (29, 30, 31, 32)


def robust(squares: Floats, limit: float) -> tuple[float, Floats]:
    """Geman-McClure cost of squared residuals and the weights of their least squares."""
    kept = 1 / (1 + squares / limit**2)
    return float((squares * kept).sum()), kept * kept


@dataclass(frozen=True, eq=False)
class Lens:
    """What is known of the camera: the principal point, px; prior of the log focal length."""

    centre: Floats
    log_focal: float
    deviation: float


def project(points: Floats, state: State, lens: Lens) -> tuple[Floats, Floats]:
    """Pixels [..., 2] of world ``points`` [..., 3], and their derivative [..., 2, 3] by the points."""
    x, y, z = np.moveaxis(points @ TO_CAMERA, -1, 0)
    z = np.maximum(z, 0.05)
    scale = state.focal / z
    pixels = np.stack([x * scale, y * scale], -1) + lens.centre
    zero = np.zeros_like(x)
    rows = [np.stack([scale, zero, -x * scale / z], -1), np.stack([zero, scale, -y * scale / z], -1)]
    return pixels, np.stack(rows, -2) @ TO_CAMERA


@dataclass(frozen=True, eq=False)
class PointTerm:
    """The marks' projections against observed points.

    Attributes:
        pixels: [T, P, 2]; deviation: [T, P] px, infinite where not seen.
    """

    pixels: Floats
    deviation: Floats
    limit: float = 3.0
    weight: float = 1.0

    def __call__(
        self,
        state: State,
        posed: Posed,
        figure: Figure,
        marks: Marks,
        layout: Layout,
        lens: Lens,
        equations: NormalEquations | None,
    ) -> float:
        points = mark_points(state, posed, marks)
        pixels, by_point = project(points, state, lens)
        inverse = 1 / self.deviation
        residual = (pixels - self.pixels) * inverse[..., None]
        cost, kept = robust((residual**2).sum(-1), self.limit)
        if equations is not None:
            by_point = by_point * inverse[..., None, None]
            local = by_point @ point_derivative(posed, points, marks.joints, layout.active)
            shared = np.zeros((*residual.shape, layout.shared))
            shared[..., layout.shape] = by_point @ marks_by_shape(posed, figure, marks)
            by_offset = posed.world[:, marks.joints] @ layout.offset_derivative()
            shared[..., layout.offsets] = by_point @ by_offset
            shared[..., layout.focal] = (pixels - lens.centre) * inverse[..., None]
            count = len(residual)
            equations.add(
                residual.reshape(count, -1),
                self.weight * np.repeat(kept, 2, axis=1),
                local.reshape(count, -1, layout.unknowns),
                shared.reshape(count, -1, layout.shared),
            )
        return self.weight * cost


@dataclass(frozen=True, eq=False)
class PositionTerm:
    """The marks against known positions [T, P, 3] m with ``deviation`` [T, P] m, infinite where unknown."""

    positions: Floats
    deviation: Floats
    limit: float = 4.0

    def __call__(
        self,
        state: State,
        posed: Posed,
        figure: Figure,
        marks: Marks,
        layout: Layout,
        equations: NormalEquations | None,
    ) -> float:
        points = mark_points(state, posed, marks)
        inverse = 1 / self.deviation
        residual = (points - self.positions) * inverse[..., None]
        cost, kept = robust((residual**2).sum(-1), self.limit)
        if equations is not None:
            local = point_derivative(posed, points, marks.joints, layout.active) * inverse[..., None, None]
            shared = np.zeros((*residual.shape, layout.shared))
            shared[..., layout.shape] = marks_by_shape(posed, figure, marks) * inverse[..., None, None]
            by_offset = posed.world[:, marks.joints] @ layout.offset_derivative()
            shared[..., layout.offsets] = by_offset * inverse[..., None, None]
            count = len(residual)
            equations.add(
                residual.reshape(count, -1),
                np.repeat(kept, 3, axis=1),
                local.reshape(count, -1, layout.unknowns),
                shared.reshape(count, -1, layout.shared),
            )
        return cost


def mark_points(state: State, posed: Posed, marks: Marks) -> Floats:
    """World positions [T, P, 3] of the marks."""
    places = marks.places + np.tensordot(state.shape, marks.basis, 1) + state.offsets
    return attached(posed, marks.joints, places)


def marks_by_shape(posed: Posed, figure: Figure, marks: Marks) -> Floats:
    """d mark points / d shape [T, P, 3, K]."""
    lever = np.moveaxis(marks.basis - figure.joint_basis[:, marks.joints], 0, -1)  # [P, 3, K]
    return shape_derivative(posed, figure.joint_basis)[:, marks.joints] + posed.world[:, marks.joints] @ lever


@dataclass(frozen=True, eq=False)
class BoneTerm:
    """Directions and rolls of bones against ``Lifted``."""

    lifted: Lifted
    limit: float = 3.0
    weight: float = 1.0

    def __call__(
        self, state: State, posed: Posed, figure: Figure, layout: Layout, equations: NormalEquations | None
    ) -> float:
        names, rest = posed.skeleton.names, figure.body.skeleton.rest_joints
        index = np.array([names.index(name) for name in JOINTS])
        parents = index[np.array(PARENTS[1:])]
        own = rest[index[1:]] - rest[parents]
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        limbs = np.array([name in LIMBS for name in JOINTS[1:]])
        axes = np.where(limbs[:, None], own, REST_DIRECTIONS)
        cost = 0.0
        for joints, axis, target, kappa in (
            (parents, axes, self.lifted.directions, self.lifted.concentration),
            (index[1:], ROLL_AXES, self.lifted.roll, self.lifted.roll_concentration),
        ):
            root = np.sqrt(kappa.astype(np.float64))[..., None]
            now = np.einsum("tpij,pj->tpi", posed.world[:, joints], axis)
            residual = (now - target.astype(np.float64) @ TO_CAMERA) * root
            part, kept = robust((residual**2).sum(-1), self.limit)
            cost += self.weight * part
            if equations is not None:
                local = direction_derivative(posed, now, joints, layout.active) * root[..., None]
                count = len(residual)
                equations.add(
                    residual.reshape(count, -1),
                    self.weight * np.repeat(kept, 3, axis=1),
                    local.reshape(count, -1, layout.unknowns),
                )
        return cost


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
        residual = sum(factors[:, k] * chain[k] for k in range(3))
        cost, kept = robust((residual**2).sum(-1), self.limit)
        turned = posed.rotations[:, active]
        steps = matrix_to_axis_angle(np.swapaxes(turned[:-1], -1, -2) @ turned[1:])  # [T − 1, A, 3]
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
        count, joints = spin.shape[:2]
        parts = []
        for block in blocks:
            part = np.zeros((count, joints, 3, layout.unknowns))
            for j in range(joints):
                part[:, j, :, 3 * j : 3 * j + 3] = block[:, j]
            parts.append(part.reshape(count, -1, layout.unknowns))
        equations.add_chain(spin.reshape(count, -1), self.weight * np.repeat(kept, 3, axis=1), parts)


@dataclass(frozen=True, eq=False)
class GroundTerm:
    """Feet stand on a plane, do not sink into it, and stay put where they stand."""

    times: Floats
    weight: float = 1.0
    height_m: float = 0.025
    reach_m: float = 0.06  # a point higher is in the air
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
        chosen = np.array(HEEL_TOE)
        soles = _part(marks, chosen)
        places = soles.places + np.tensordot(state.shape, soles.basis, 1)
        points = attached(posed, soles.joints, places)
        up = state.up
        heights = points @ up - state.ground[0]
        lowest = np.minimum(heights, self.reach_m * 3)
        cost, kept = robust((lowest / self.height_m) ** 2, self.reach_m / self.height_m)
        kept = np.where(heights < self.reach_m * 3, kept, 0)
        below = np.where(heights < 0, 1.0, 0.0)
        sunk = np.minimum(heights, 0) / self.height_m
        cost += float((sunk**2).sum())
        standing = np.exp(-0.5 * np.maximum(heights, 0) ** 2 / self.reach_m**2)
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
            for k, axis in ((1, 0), (2, 2)):
                shared[..., layout.ground.start + k] = points[..., axis] - up[axis] * (points @ up)
            scale = 1 / self.height_m
            weight = self.weight * (kept + below)
            equations.add(heights * scale, weight, height_by * scale, shared * scale)
            moved = (local / self.slip).reshape(len(local), -1, layout.unknowns)
            by = [-moved[:-1] / span, moved[1:] / span]
            pair = np.repeat(weights * slide_kept**2, 3, axis=1) * self.weight
            equations.add_chain(slide.reshape(len(slide), -1), pair, by)
        return self.weight * (cost + slide_cost)


def _part(marks: Marks, chosen: NDArray[np.int64]) -> Marks:
    return Marks(
        marks.joints[chosen],
        marks.places[chosen],
        marks.basis[:, chosen],
        marks.mirror[chosen],
        marks.freedom_m[chosen],
    )


@dataclass(frozen=True, eq=False)
class SharedTerm:
    """Priors of what all frames share.

    Attributes:
        weight: of the priors; errors of one video's landmarks are alike in all its frames, so it grows with them.
        height: of the body, m; by default the template's, as one camera does not tell the scale.
        scale_known: whether the data tell the scale; the height is then a parameter like the others.
        tilt: rad, deviation of the ground from the camera's level.
    """

    lens: Lens
    weight: float = 1.0
    height: float | None = None
    scale_known: bool = False
    tilt: float = 0.15
    height_deviation: float = 0.003

    def __call__(
        self, state: State, figure: Figure, marks: Marks, layout: Layout, equations: NormalEquations | None
    ) -> float:
        freedom = np.repeat(marks.freedom_m[layout.free], 3)
        inverse = np.concatenate(
            [np.ones(len(state.shape)), 1 / freedom, [1 / self.lens.deviation, 0.0], [1 / self.tilt] * 2]
        )
        values = np.concatenate(
            [state.shape, state.offsets[layout.free].ravel(), [state.log_focal - self.lens.log_focal], state.ground]
        )
        matrix = np.diag(inverse)
        residual = inverse * values
        weight = np.full(len(residual), self.weight)
        if "height" in figure.names and not self.scale_known:
            vertices, basis = figure.body.vertices[:, 1], figure.vertex_basis[..., 1]
            high, low = vertices.argmax(), vertices.argmin()
            row = np.zeros(layout.shared)
            row[layout.shape] = (basis[:, high] - basis[:, low]) / self.height_deviation
            matrix = np.concatenate([matrix, row[None]])
            wanted = figure.height(0 * state.shape) if self.height is None else self.height
            residual = np.append(residual, (figure.height(state.shape) - wanted) / self.height_deviation)
            weight = np.append(weight, self.weight)
            weight[figure.names.index("height")] = 1e-3
        if equations is not None:
            equations.add_shared(residual, weight, matrix)
        return float((weight * residual**2).sum())
