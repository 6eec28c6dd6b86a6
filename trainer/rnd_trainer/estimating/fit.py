"""The joint fit over a clip: pose, position, shape, focal length and ground from what networks see of one person."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from rnd_runtime.capture.body import Body
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Motion

from .fit_settings import COMPARISON, CONVERGED, STAGES, WEIGHTS, Stage, Weights
from .fitting.appearance import AppearanceTerm, appearance_term
from .fitting.figure import Figure, default_figure, known_figure
from .fitting.image_motion import FlowTerm
from .fitting.kinematics import Posed
from .fitting.marks import HAND_MARKS, KNUCKLES, Marks, marks_of
from .fitting.normal_equations import NormalEquations
from .fitting.pose_terms import BalanceTerm, GroundTerm, PriorTerm, SmoothTerm, StillTerm
from .fitting.prior import pose_prior
from .fitting.silhouette import INSET_M, Outlines, OutlineTerm, outlines_of, rim_matches
from .fitting.start import joint_rotations, local_rotations, root_positions
from .fitting.state import TO_CAMERA, Layout, State
from .fitting.surface import Surface
from .fitting.terms import BoneTerm, Lens, PointTerm, SharedTerm, mark_points, project
from .lifted import Lifted
from .lifter import lift
from .observations import FACE, FEET, FINGERS, LANDMARKS, TRUNK, Observations

Floats = NDArray[np.float64]
OnProgress = Callable[[float, float], None]
"""called with steps done and steps in all"""

MIN_FRAMES = 12
"""fewer frames tell too little of the body"""
USUAL_FOCAL = 1.4
"""focal length over the image's shorter side: phones film 16:9 at 0.7 to 0.9 of the longer; crops keep the shorter"""
FOCAL_DEVIATION = 0.20
KNOWN_FOCAL_DEVIATION = 0.003
MAX_TURN, MAX_SHIFT = 0.5, 0.4
"""bounds of one step: rad of a joint, m of the root"""
CORRELATION = 3.5
"""errors of neighbouring frames and points are alike: measured errors over deviations that take them as independent"""
_LESS_SURE = ((TRUNK, 1.5), (FACE, 1.3), (FINGERS, 1.5))  # factors of their deviation
_START_SHARE = 0.1  # weight of face and fingers for the first positions


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a video says of a person.

    Attributes:
        motion: one pose for each observed frame; the world has Y up, its ground is y = 0.
        body: the person's body at rest, with ``motion``'s joints.
        camera: of all frames, in that world.
        frames: [T] numbers of the poses' frames in the video.
        rotation_deviation: [T, J, 3] rad, of each joint's rotation about its own axes; ``translation_deviation``
            [T, 3] m, of the root.
        shape: the figure's parameters by name.
        notes: assumptions, one sentence each.
        residual_px: [T] median distance of the confident landmarks from the body's.
    """

    motion: Motion
    body: Body
    camera: Camera
    frames: NDArray[np.int64]
    rotation_deviation: Floats
    translation_deviation: Floats
    shape: dict[str, float]
    notes: tuple[str, ...]
    residual_px: Floats
    state: State = field(repr=False)


def estimate(
    observations: Observations,
    lifted: Lifted | None = None,
    *,
    body: Body | Figure | None = None,
    height: float | None = None,
    focal_px: float | None = None,
    principal_px: tuple[float, float] | None = None,
    weights: Weights = WEIGHTS,
    on_progress: OnProgress = lambda done, total: None,
) -> Estimate:
    """Fit a body to all frames of ``observations`` at once.

    Args:
        lifted: directions of bones in the same frames; by default the shipped network's.
        body: a ``Body`` keeps its shape; a ``Figure`` is shaped; by default the figure that ships.
        height: of the person, m; fixes the scale. By default the mean adult's, as far as nothing else tells.
        focal_px: focal length in pixels, if known.
        principal_px: by default the image's middle.

    Raises:
        InputError: too few frames, or an impossible height or focal length.
    """
    count = len(observations)
    if count < MIN_FRAMES:
        raise InputError("video", expected=f"at least {MIN_FRAMES} frames of the person", got=count)
    if height is not None and not 0.5 <= height <= 2.5:
        raise InputError("--height", expected="0.5 to 2.5 m", got=height)
    if focal_px is not None and not (np.isfinite(focal_px) and focal_px > 0):
        raise InputError("focal length", expected="a positive number of pixels", got=focal_px)
    figure = default_figure() if body is None else known_figure(body) if isinstance(body, Body) else body
    lens = _lens(observations, focal_px, principal_px)
    if lifted is None:
        lifted = lift(observations, float(np.exp(lens.log_focal)), lens.centre)
    if len(lifted) != count:
        raise InputError("lifted bones", expected=f"{count} frames", got=len(lifted))
    fit = Fit(observations, lifted, figure, lens, height, weights)
    total, done = sum(stage.length for stage in STAGES), 0
    with threadpool_limits(1, "blas"):  # for matrices of 70 columns threads only wait
        for stage in STAGES:
            fit.run(stage, partial(_report, on_progress, done, total))
            done += stage.length
            on_progress(done, total)
    return fit.result()


def _report(on_progress: OnProgress, done: int, total: int, steps: float) -> None:
    on_progress(done + steps, total)


def _lens(observations: Observations, focal_px: float | None, principal_px: tuple[float, float] | None) -> Lens:
    width, height = observations.image_size
    centre = np.array(principal_px if principal_px is not None else (width / 2, height / 2), np.float64)
    if focal_px is not None:
        return Lens(centre, float(np.log(focal_px)), KNOWN_FOCAL_DEVIATION)
    return Lens(centre, float(np.log(USUAL_FOCAL * min(width, height))), FOCAL_DEVIATION)


class Fit:
    """A fit in progress."""

    def __init__(
        self,
        observations: Observations,
        lifted: Lifted,
        figure: Figure,
        lens: Lens,
        height: float | None,
        weights: Weights = WEIGHTS,
    ) -> None:
        self.observations, self.lifted, self.figure, self.lens = observations, lifted, figure, lens
        self.height, self.weights = height, weights
        self.marks: Marks = marks_of(figure)
        self.layout = Layout(figure, self.marks)
        self.times = observations.frames / observations.fps
        self.surface = Surface(figure)
        self.outlines: Outlines | None = None
        self.damping = 1e-3
        self.cost = np.inf
        self.state = self._start()
        self._smooth = self._smoothness()
        self._appearance: tuple[AppearanceTerm, ...] = ()
        self._still = StillTerm.of(self.times, self.state.rotations, self.figure.body.skeleton.names, weights.still)

    def _start(self) -> State:
        observations, figure = self.observations, self.figure
        rotations = local_rotations(TO_CAMERA @ joint_rotations(self.lifted), figure.body.skeleton)
        count = len(observations)
        shape = np.zeros(len(figure.names))
        if self.height is not None and "height" in figure.names:
            unit, tall = np.zeros(len(shape)), figure.names.index("height")
            unit[tall] = 1
            shape[tall] = (self.height - figure.height(0 * unit)) / (figure.height(unit) - figure.height(0 * unit))
        focal = float(np.exp(self.lens.log_focal))
        state = State(
            rotations, np.zeros((count, 3)), shape, np.zeros_like(self.marks.places), self.lens.log_focal, np.zeros(3)
        )
        posed = state.posed(figure)
        points = mark_points(state, posed, self.marks)[:, :LANDMARKS] @ TO_CAMERA
        sure = observations.confidence.astype(np.float64) ** 2 / (1 + observations.spread_px.astype(np.float64) ** 2)
        sure[:, FACE + FINGERS] *= _START_SHARE
        shift = root_positions(points, observations.keypoints_px.astype(np.float64), sure, focal, self.lens.centre)
        translations = shift @ TO_CAMERA
        state = replace(state, translations=translations)
        posed = state.posed(figure)
        soles = mark_points(state, posed, self.marks)[:, FEET, 1].min(1)
        return replace(state, ground=np.array([np.quantile(soles, 0.3), 0.0, 0.0]))

    def _scale(self) -> Floats:
        """Pixels a metre [T] at the person's distance."""
        posed = self.state.posed(self.figure)
        return np.asarray(self.state.focal / np.maximum(-posed.joints[:, 0, 2], 0.1))

    def _point_term(self, stage: Stage) -> PointTerm:
        o, w = self.observations, self.weights
        count, total = len(o), len(self.marks.joints)
        pixels, deviation = np.zeros((count, total, 2)), np.full((count, total), np.inf)
        scale = self._scale()[:, None]
        pixels[:, :LANDMARKS] = o.keypoints_px
        confidence = np.clip(o.confidence.astype(np.float64), 1e-3, 1)
        base = w.mark_m * scale * np.ones((1, LANDMARKS))
        for marks, factor in _LESS_SURE:
            base[:, marks] *= factor
        deviation[:, :LANDMARKS] = np.hypot(base / confidence, w.spread * o.spread_px)
        for side in range(2):
            sure = o.hands_confidence[:, side].astype(np.float64)
            seen = (sure > 0.3) & np.isfinite(o.hands_px[:, side]).all((1, 2))
            here = slice(HAND_MARKS + 4 * side, HAND_MARKS + 4 * side + 4)
            pixels[seen, here] = o.hands_px[seen, side][:, list(KNUCKLES)]
            deviation[seen, here] = (0.6 * w.mark_m * scale / np.clip(sure, 0.1, 1)[:, None])[seen]
        deviation[:, :LANDMARKS][~np.isfinite(o.keypoints_px).all(-1)] = np.inf
        pixels = np.nan_to_num(pixels)
        return PointTerm(pixels, deviation, stage.limit, w.points * stage.points)

    def _smoothness(self) -> SmoothTerm:
        w, names = self.weights, self.figure.body.skeleton.names
        limb = {"knee": 2.0, "ankle": 2.5, "foot": 3.0, "elbow": 2.0, "wrist": 2.7}
        factors = np.array([limb.get(n.split("_")[-1], 1.0) for n in names])
        spins = np.array([2.0 if n.split("_")[-1] in (*limb, "hip", "shoulder") else 0.8 for n in names])
        return SmoothTerm(self.times, w.acceleration * factors, w.spin * spins, w.smooth)

    def _balance_term(self) -> BalanceTerm:
        posed = self.state.posed(self.figure)
        return BalanceTerm.of(self.figure, self.marks, self.state, posed, self.weights.balance)

    def _outline_term(self) -> OutlineTerm:
        if self.outlines is None:
            o = self.observations
            self.outlines = outlines_of(o.masks, len(o), o.image_size, o.hidden)
        posed = self.state.posed(self.figure)
        matches = rim_matches(self.surface, self.state, posed, self.lens, self.outlines)
        w, scale = self.weights, self._scale()
        return OutlineTerm(
            self.surface, self.outlines, matches, w.outline_m * scale, INSET_M * scale, w.outline, w.inner
        )

    def _flow_terms(self) -> list[FlowTerm]:
        posed, scale = self.state.posed(self.figure), self._scale()
        flows = [flow for flow in self.observations.flow if len(flow.boxes)]
        frames = max((len(flow.boxes) for flow in flows), default=0)
        visible = [self.surface.visible(self.state, posed, self.lens, frame) for frame in range(frames)]
        return [FlowTerm.of(self.surface, visible, flow, scale, self.weights.flow) for flow in flows]

    def evaluate(
        self,
        state: State,
        points: PointTerm,
        outline: OutlineTerm | None,
        others: Sequence[BalanceTerm | FlowTerm | AppearanceTerm] = (),
        equations: NormalEquations | None = None,
    ) -> float:
        """Cost of ``state``; adds its derivatives to ``equations``."""
        figure, marks, layout, lens, w = self.figure, self.marks, self.layout, self.lens, self.weights
        posed = state.posed(figure)
        cost = points(state, posed, figure, marks, layout, lens, equations)
        bones = BoneTerm(self.lifted, weight=w.bones, limbs=w.limbs, trunk=w.trunk)
        cost += bones(state, posed, figure, layout, equations)
        cost += PriorTerm(pose_prior(), w.prior)(posed, layout, equations)
        cost += self._smooth(posed, layout, equations)
        cost += self._still(posed, layout, equations)
        cost += GroundTerm(self.times, w.ground, w.slide)(state, posed, figure, marks, layout, equations)
        cost += SharedTerm(lens, 1 + w.shared * len(state.translations), self.height)(
            state, figure, marks, layout, equations
        )
        if outline is not None:
            cost += outline(state, posed, layout, lens, equations)
        return cost + sum(term(state, posed, layout, lens, equations) for term in others)

    def run(self, stage: Stage, on_steps: Callable[[float], None]) -> None:
        """All steps of a stage, until its cost hardly falls; ``on_steps`` is called with how many are done."""
        self._compare(stage, lambda share: on_steps(COMPARISON * share))
        cost = np.inf
        for number in range(stage.steps):
            before, cost = cost, self.advance(stage)
            on_steps(stage.length - stage.steps + number + 1)
            if number >= 2 and cost > before * (1 - CONVERGED):
                break

    def _compare(self, stage: Stage, on_share: Callable[[float], None]) -> None:
        """Compare frames with each other, if ``stage`` needs that, in the pose so far."""
        person, weight = self.observations.person, self.weights.appearance
        self._appearance = ()
        if stage.appearance and person is not None:
            posed = self.state.posed(self.figure)
            term = appearance_term(self.surface, self.state, posed, self.lens, person, weight, on_share)
            self._appearance = (term,)

    def advance(self, stage: Stage) -> float:
        """One Gauss-Newton step with the terms of ``stage``; its cost."""
        points = self._point_term(stage)
        outline = self._outline_term() if stage.surface else None
        flows = self._flow_terms() if stage.surface else []
        reach = max([2, *(flow.gap for flow in flows)])
        equations = NormalEquations(len(self.observations), self.layout.unknowns, self.layout.shared, reach)
        others: list[BalanceTerm | FlowTerm | AppearanceTerm] = [self._balance_term(), *flows, *self._appearance]
        before = self.evaluate(self.state, points, outline, others, equations)
        for _ in range(4):
            local, shared = equations.solve(self.damping)
            turn = np.clip(local[:, :-3], -MAX_TURN, MAX_TURN)
            local = np.concatenate([turn, np.clip(local[:, -3:], -MAX_SHIFT, MAX_SHIFT)], 1)
            state = self.layout.moved(self.state, local, shared)
            after = self.evaluate(state, points, outline, others)
            if after <= before:
                self.state, self.damping = state, max(self.damping * 0.3, 1e-5)
                break
            self.damping = min(self.damping * 8 + 1e-4, 1e3)
        self.cost = min(before, after)
        self._equations = equations
        return self.cost

    def result(self) -> Estimate:
        """The estimate in a world whose ground is level at y = 0."""
        state, figure, observations = self.state, self.figure, self.observations
        body = figure.shaped(state.shape)
        names = body.skeleton.names
        level = _level(state.up)
        posed = state.posed(figure)
        roots = posed.joints[:, 0] @ level.T
        middle = np.array([roots[:, 0].mean(), state.ground[0], roots[:, 2].mean()])
        rotations = state.rotations.copy()
        rotations[:, 0] = level @ rotations[:, 0]
        translations = roots - middle - body.skeleton.rest_joints[0]
        motion = Motion(rotations, translations, observations.fps, names)
        matrix = np.eye(4)
        matrix[:3, :3] = TO_CAMERA @ level.T
        matrix[:3, 3] = matrix[:3, :3] @ middle
        width, height = observations.image_size
        K = np.array([[state.focal, 0, self.lens.centre[0]], [0, state.focal, self.lens.centre[1]], [0, 0, 1]])
        camera = Camera(width, height, K, matrix)
        deviations = CORRELATION * np.sqrt(self._equations.variances())
        turned = np.zeros((len(observations), len(names), 3))
        turned[:, self.layout.active] = deviations[:, :-3].reshape(len(observations), -1, 3)
        return Estimate(
            motion,
            body,
            camera,
            observations.frames,
            turned,
            deviations[:, -3:],
            dict(zip(figure.names, state.shape.tolist())),
            (),
            self._residuals(posed),
            state,
        )

    def _residuals(self, posed: Posed) -> Floats:
        pixels, _ = project(mark_points(self.state, posed, self.marks)[:, :LANDMARKS], self.state, self.lens)
        gaps = np.linalg.norm(pixels - self.observations.keypoints_px, axis=-1)
        sure = self.observations.confidence > 0.5
        return np.array([np.median(gap[here]) if here.any() else np.inf for gap, here in zip(gaps, sure)])


def _level(up: Floats) -> Floats:
    """The smallest rotation [3, 3] that takes ``up`` to Y."""
    axis = np.cross(up, [0.0, 1.0, 0.0])
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + up[1])
