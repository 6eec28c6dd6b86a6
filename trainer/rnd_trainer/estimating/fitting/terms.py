"""The terms of the fit: each returns its robust cost and adds its derivatives to the normal equations.

Residuals are in deviations, so that costs of all terms add. ``Geman-McClure``: ρ(r²) = r² / (1 + r²/c²).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.lifted import PARENTS, REST_DIRECTIONS, ROLL_AXES, Lifted

from .figure import JOINTS, Figure
from .kinematics import Posed, attached, direction_derivative, point_derivative, shape_derivative
from .marks import Marks
from .normal_equations import NormalEquations
from .state import TO_CAMERA, Layout, State

Floats = NDArray[np.float64]

LIMBS = tuple(f"{side}_{name}" for side in ("left", "right") for name in ("knee", "ankle", "elbow", "wrist"))


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
    """Directions and rolls of bones against ``Lifted``.

    Attributes:
        limbs, trunk: rad, deviation of the lifter's idea of a bone from the body's, beside the lifter's own; rigs
            differ in the trunk, neck and collars.
    """

    lifted: Lifted
    limit: float = 3.0
    weight: float = 1.0
    limbs: float = 0.0
    trunk: float = 0.0

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
        beside = np.where(limbs, self.limbs, self.trunk)
        cost = 0.0
        for joints, axis, target, kappa, other in (
            (parents, axes, self.lifted.directions, self.lifted.concentration, beside),
            (index[1:], ROLL_AXES, self.lifted.roll, self.lifted.roll_concentration, self.limbs),
        ):
            root = np.sqrt(1 / (1 / kappa.astype(np.float64) + other**2))[..., None]
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


@dataclass(frozen=True, eq=False)
class SharedTerm:
    """Priors of what all frames share.

    Attributes:
        weight: of the priors; errors of one video's landmarks are alike in all its frames, so it grows with them.
        height: of the body, m; by default the template's, as one camera does not tell the scale.
        tilt: rad, deviation of the ground from the camera's level.
    """

    lens: Lens
    weight: float = 1.0
    height: float | None = None
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
        if "height" in figure.names:
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
