"""The joint fit on synthetic landmarks of a known motion; no network is needed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.fit import Fit, _lens, estimate
from rnd_trainer.estimating.fit_settings import Stage, Weights
from rnd_trainer.estimating.fitting.appearance import appearance_term
from rnd_trainer.estimating.fitting.figure import default_figure
from rnd_trainer.estimating.fitting.kinematics import attached, pose
from rnd_trainer.estimating.fitting.marks import marks_of
from rnd_trainer.estimating.fitting.normal_equations import NormalEquations
from rnd_trainer.estimating.fitting.pose_terms import BalanceTerm, _soles
from rnd_trainer.estimating.fitting.silhouette import INSET_M, outlines_of
from rnd_trainer.estimating.fitting.state import TO_CAMERA
from rnd_trainer.estimating.fitting.terms import mark_points, project
from rnd_trainer.estimating.flow import CELLS, Flow, flow_of
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_DIRECTIONS, ROLL_AXES, Lifted
from rnd_trainer.estimating.observations import BLAZEPOSE, GreyImages, Observations, only_person

FRAMES, SIZE, FOCAL, FPS = 16, 200, 260.0, 15.0
HANGING = 0.8
"""added downwards to the directions of arms that are seen from the side"""
SHAPE = {"height": 0.6, "legs": 0.8, "arms": -0.7, "gender": 0.5}


def known_person(noise_px: float = 0.7, seed: int = 0, *, held: bool = False, roll: float = 0.0):
    """Observations and bones of a person who turns; true joints [T, 24, 3] m in camera axes; the body.

    Who holds the pose turns by half a circle, and the directions of arms are believed to hang when seen from the side.
    The camera is rolled by ``roll`` rad.
    """
    figure = default_figure()
    shape = np.array([SHAPE.get(name, 0.0) for name in figure.names])
    body = figure.shaped(shape)
    names = body.skeleton.names
    phase = np.linspace(0, 1, FRAMES)
    moving = np.full(FRAMES, 0.4) if held else phase
    vectors = np.zeros((FRAMES, len(names), 3))
    vectors[:, 0, 1] = np.pi * phase if held else -0.8 + 1.6 * phase
    for side, sign in (("left", 1), ("right", -1)):
        vectors[:, names.index(f"{side}_shoulder"), 2] = sign * (-1.2 + 0.9 * moving)
        vectors[:, names.index(f"{side}_elbow"), 1] = -sign * (0.3 + 0.8 * moving)
        vectors[:, names.index(f"{side}_hip"), 0] = -0.15 - 0.1 * sign * np.sin(3 * moving)
        vectors[:, names.index(f"{side}_knee"), 0] = 0.3
    rotations = axis_angle_to_matrix(vectors)
    translations = np.stack([0.1 * phase, np.full(FRAMES, -1.0), np.full(FRAMES, -3.2)], 1)
    rolled = axis_angle_to_matrix(np.array([0.0, 0.0, roll]))
    rotations[:, 0] = rolled @ rotations[:, 0]
    root = body.skeleton.rest_joints[0]
    translations = (root + translations) @ rolled.T - root
    posed = pose(body.skeleton, rotations, translations, body.skeleton.rest_joints)
    marks = marks_of(figure)
    places = marks.places + np.tensordot(shape, marks.basis, 1)
    points = attached(posed, marks.joints, places)[:, :33] @ TO_CAMERA
    pixels = FOCAL * points[..., :2] / points[..., 2:] + SIZE / 2
    rng = np.random.default_rng(seed)
    masks, images = [], []
    patches = np.unique(np.floor(body.vertices[body.faces[:, 0]] / 0.05), axis=0, return_inverse=True)[1].ravel()
    paint = np.random.default_rng(5).integers(40, 256, (patches.max() + 1, 3))[patches].tolist()
    for frame in range(FRAMES):
        vertices = posed_vertices(body, rotations[frame], translations[frame]) @ TO_CAMERA
        flat = FOCAL * vertices[:, :2] / vertices[:, 2:] + SIZE / 2
        image = np.zeros((4 * SIZE, 4 * SIZE, 3), np.uint8)
        triangles = (flat[body.faces] * 4 * 16).astype(np.int32)
        for k in np.argsort(-vertices[body.faces, 2].mean(1)):
            cv2.fillConvexPoly(image, triangles[k], paint[k], shift=4)
        image = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        masks.append(np.where(image.max(-1) > 20, 255, 0).astype(np.uint8))
        images.append(image)
    hint = points - points[:, 23:25].mean(1, keepdims=True)
    index = [names.index(name) for name in JOINTS]
    world = TO_CAMERA @ posed.world[:, index]
    directions = np.stack([world[:, PARENTS[j]] @ REST_DIRECTIONS[j - 1] for j in range(1, 22)], 1)
    bones = (posed.joints[:, index[1:]] - posed.joints[:, [index[p] for p in PARENTS[1:]]]) @ TO_CAMERA
    limbs = [name.endswith(("knee", "ankle", "elbow", "wrist")) for name in JOINTS[1:]]
    directions[:, limbs] = (bones / np.linalg.norm(bones, axis=-1, keepdims=True))[:, limbs]
    if held:
        arms = [name.endswith(("elbow", "wrist")) for name in JOINTS[1:]]
        directions[:, arms] += HANGING * np.sin(vectors[:, 0, 1])[:, None, None] * np.array([0.0, 1.0, 0.0])
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rolls = np.stack([world[:, j] @ ROLL_AXES[j - 1] for j in range(1, 22)], 1)
    lifted = Lifted(*(part for v in (directions, rolls) for part in perturbed(v, np.radians(5), rng)))
    if held:  # as the lifter errs: smoothly in time
        lifted = replace(lifted, directions=directions.astype(np.float32), roll=rolls.astype(np.float32))
    observations = Observations(
        FPS,
        (SIZE, SIZE),
        np.arange(FRAMES),
        (pixels + rng.normal(scale=noise_px, size=pixels.shape)).astype(np.float32),
        np.full((FRAMES, 33), 0.95, np.float32),
        np.zeros((FRAMES, 33), np.float32),
        (hint + rng.normal(scale=0.02, size=hint.shape)).astype(np.float32),
        np.full((FRAMES, 2, 21, 2), np.nan, np.float32),
        np.zeros((FRAMES, 2), np.float32),
        GreyImages.of(masks, (SIZE, SIZE)),
        flow_of(images.__getitem__, masks, FPS),
        GreyImages.of(map(only_person, images, masks), (SIZE, SIZE)),
    )
    return observations, lifted, posed.joints @ TO_CAMERA, body


def perturbed(vectors: np.ndarray, angle: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Unit ``vectors`` [T, 21, 3] that err by ``angle`` rad along each axis, and their concentration."""
    moved = vectors + rng.normal(scale=angle, size=vectors.shape)
    moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
    return moved.astype(np.float32), np.full(vectors.shape[:2], 1 / angle**2, np.float32)


@pytest.fixture(scope="module")
def person():
    return known_person()


def camera_joints(result) -> np.ndarray:
    skeleton = result.body.skeleton
    posed = pose(skeleton, result.motion.rotations, result.motion.translations, skeleton.rest_joints)
    matrix = result.camera.world_to_camera
    return posed.joints @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.slow
def test_it_recovers_a_known_motion(person):
    observations, lifted, truth, body = person
    height = float(np.ptp(body.vertices[:, 1]))
    result = estimate(observations, lifted, focal_px=FOCAL, height=height)
    found = camera_joints(result)
    limbs = [
        body.skeleton.names.index(f"{s}_{n}") for s in ("left", "right") for n in ("knee", "ankle", "elbow", "wrist")
    ]
    relative = np.linalg.norm((found - found[:, :1]) - (truth - truth[:, :1]), axis=-1)
    assert relative[:, limbs].mean() < 0.030 and relative.mean() < 0.022
    assert np.linalg.norm(found - truth, axis=-1).mean() < 0.08
    assert abs(np.ptp(result.body.vertices[:, 1]) - height) < 0.03  # clothes' thickness is not known
    assert result.residual_px.max() < 4
    # the uncertainty is of the errors' size: sideways less than in depth
    sideways, up, away = np.median(result.translation_deviation, axis=0)
    assert 0.001 < max(sideways, up) < away < 0.2
    soles = [
        posed_vertices(result.body, r, t)[:, 1].min()
        for r, t in zip(result.motion.rotations, result.motion.translations)
    ]
    assert abs(np.median(soles)) < 0.10


@pytest.mark.slow
def test_who_stands_tells_how_the_camera_is_rolled():
    roll = np.radians(20.0)
    observations, lifted, _, body = known_person(roll=roll)
    errors = []
    for balance in (0.0, Weights().balance):
        weights = replace(Weights(), balance=balance)
        up = estimate(observations, lifted, body=body, focal_px=FOCAL, weights=weights).camera.world_to_camera[:3, 1]
        errors.append(abs(np.arctan2(up[0], -up[1]) + roll))
    assert errors[1] < np.radians(3) and errors[1] < 0.5 * errors[0], np.degrees(errors)


def test_who_sits_or_jumps_tells_nothing_of_the_ground(person):
    observations, lifted = person[:2]
    fit = Fit(observations, lifted, default_figure(), _lens(observations, FOCAL, None), None)
    names = fit.figure.body.skeleton.names
    bent = fit.state.rotations.copy()
    for side in ("left", "right"):
        for joint, angle in (("hip", -1.5), ("knee", 1.5)):
            bent[:, names.index(f"{side}_{joint}")] = axis_angle_to_matrix(np.array([angle, 0.0, 0.0]))
    sitting = replace(fit.state, rotations=bent)
    soles = _soles(sitting, sitting.posed(fit.figure), fit.marks)[1][..., 1].min()
    for state, upright in (
        (fit.state, True),
        (replace(sitting, ground=np.array([soles, 0.0, 0.0])), False),
        (replace(fit.state, ground=fit.state.ground - [0.3, 0.0, 0.0]), False),
    ):
        term = BalanceTerm.of(fit.figure, fit.marks, state, state.posed(fit.figure), 1.0)
        assert (np.median(term.upright) > 0.9) == upright and (term.upright.max() < 0.01) != upright


@pytest.mark.slow
def test_a_pose_that_is_held_is_seen_from_all_sides():
    observations, lifted, truth, body = known_person(held=True)
    observations = replace(observations, fps=5.0, flow=())  # half a turn in three seconds
    arms = [body.skeleton.names.index(f"{side}_{name}") for side in ("left", "right") for name in ("elbow", "wrist")]
    from_the_side = np.abs(np.linspace(-1, 1, FRAMES)) < 0.4
    errors = []
    for still in (0.0, 1.0):
        result = estimate(observations, lifted, body=body, focal_px=FOCAL, weights=replace(Weights(), still=still))
        found = camera_joints(result)
        relative = np.linalg.norm((found - found[:, :1]) - (truth - truth[:, :1]), axis=-1)
        errors.append(relative[from_the_side][:, arms].mean())
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_flow_mends_what_is_wrong_for_a_while():
    observations, lifted, truth, body = known_person()
    rng = np.random.default_rng(4)
    astray = gaussian_filter1d(rng.normal(size=(FRAMES, 33, 2)), 2, axis=0)
    pixels = (observations.keypoints_px + 6 * astray).astype(np.float32)
    lean = axis_angle_to_matrix(0.5 * gaussian_filter1d(rng.normal(size=(FRAMES, 21, 3)), 2, axis=0))
    directions, roll = (
        np.einsum("tpij,tpj->tpi", lean, v).astype(np.float32) for v in (lifted.directions, lifted.roll)
    )
    lifted = replace(lifted, directions=directions, roll=roll)
    errors = []
    for flow in ((), observations.flow):
        seen = replace(observations, keypoints_px=pixels, flow=flow)
        found = camera_joints(estimate(seen, lifted, body=body, focal_px=FOCAL))
        errors.append(np.linalg.norm((found - found[:, :1]) - (truth - truth[:, :1]), axis=-1).mean())
    assert errors[1] < 0.8 * errors[0], errors


@pytest.mark.slow
def test_what_other_frames_show_mends_what_is_wrong_in_some():
    observations, lifted, truth, body = known_person()
    rng = np.random.default_rng(5)
    wrong = slice(5, 9)
    pixels = observations.keypoints_px.copy()
    pixels[wrong] += 5 * rng.normal(size=(33, 2)).astype(np.float32)  # alike in all, so that they look smooth
    errors = []
    for person in (None, observations.person):
        seen = replace(observations, keypoints_px=pixels, flow=(), person=person)
        found = camera_joints(estimate(seen, lifted, body=body, focal_px=FOCAL))
        errors.append(np.linalg.norm((found - found[:, :1]) - (truth - truth[:, :1]), axis=-1)[wrong].mean())
    assert errors[1] < 0.75 * errors[0], errors


@pytest.mark.parametrize(
    ("term", "part"),
    [(term, part) for term in ("points", "outlines") for part in ("pose", "root", "shape", "offsets", "focal")]
    + [("appearance", part) for part in ("pose", "root", "shape", "focal")]
    + [(term, part) for term in ("ground", "balance") for part in ("pose", "root", "shape", "ground")]
    + [("flow", "pose"), ("flow", "root")],  # flow and smoothness count a pose's part alone
)
def test_derivatives_agree_with_differences(person, term, part):
    few, lifted = person[0].select(np.arange(4)), parts_of(person[1], 4)
    weights = replace(Weights(), smooth=0.0) if part == "shape" else Weights()
    if term != "points":
        weights = replace(Weights(), points=0, bones=0, prior=0, smooth=0, still=0, shared=0)
    weights = replace(weights, ground=float(term == "ground"), slide=0.0, balance=400.0 * (term == "balance"))
    fit = Fit(few, lifted, default_figure(), _lens(few, 240.0, None), 1.7, weights)
    tilted = replace(fit.state, ground=np.array([0.0, 0.5, -0.4]))
    low = (_soles(tilted, tilted.posed(fit.figure), fit.marks)[1] @ tilted.up).min()
    fit.state = replace(tilted, ground=np.array([low, 0.5, -0.4]))
    points, outline, images = fit._point_term(Stage(1)), None, []
    if term == "outlines":  # wide limits: the weights of far matches are constants of a step
        outline = replace(fit._outline_term(), inner_weight=0.0, limit=1e4)
    if term == "balance":
        images = [fit._balance_term()]
    if term == "flow":
        whole = person[0].flow
        cut = [Flow(f.gap, f.boxes[: 4 - f.gap], f.displacement[: 4 - f.gap]) for f in whole]
        fit.observations = replace(few, flow=tuple(cut))
        images = fit._flow_terms()
        assert [len(term.vertices) for term in images] == [3, 2]
        assert min((term.inverse > 0).sum(1).min() for term in images) > 20
    if term == "appearance":
        images = [appearance_term(fit.surface, fit.state, fit.state.posed(fit.figure), fit.lens, few.person, 1.0)]
        assert (images[0].inverse > 0).sum(1).min() > 20
    equations = NormalEquations(4, fit.layout.unknowns, fit.layout.shared)
    fit.evaluate(fit.state, points, outline, images, equations)
    rng = np.random.default_rng(0)
    local, shared = np.zeros((4, fit.layout.unknowns)), np.zeros(fit.layout.shared)
    if part == "pose":
        local[:, :-3] = rng.normal(size=local[:, :-3].shape)
    elif part == "root":
        local[:, -3:] = rng.normal(size=(4, 3))
    else:
        here = getattr(fit.layout, part)
        shared[here] = rng.normal(size=shared[here].shape)
    small = 1e-5
    ahead, behind = (
        fit.evaluate(fit.layout.moved(fit.state, s * local, s * shared), points, outline, images)
        for s in (small, -small)
    )
    slope = 2 * ((equations.gradient * local).sum() + equations.shared_gradient @ shared)
    assert (ahead - behind) / (2 * small) == pytest.approx(slope, rel=1e-3, abs=0.05)


def parts_of(lifted: Lifted, count: int) -> Lifted:
    names = ("directions", "concentration", "roll", "roll_concentration")
    return Lifted(*(getattr(lifted, name)[:count] for name in names))


def test_a_leg_behind_somebody_is_not_pulled_out(person):
    few, lifted = person[0].select(np.arange(4)), parts_of(person[1], 4)
    ankle = BLAZEPOSE.index("left_ankle")
    behind = np.zeros((4, SIZE, SIZE), np.uint8)
    for image, (x, y) in zip(behind, few.keypoints_px[:, ankle].astype(int)):
        image[y - 14 : y + 20, x - 9 : x + 25] = 255
    masks = GreyImages.of((np.where(h > 0, 0, mask) for h, mask in zip(behind, few.masks)), few.image_size)
    confidence = few.confidence.copy()
    confidence[:, [k for k, name in enumerate(BLAZEPOSE) if name.startswith("left") and k > 24]] = 0.01
    errors = []
    for hidden in (None, GreyImages.of(behind, few.image_size)):
        seen = replace(few, masks=masks, confidence=confidence, hidden=hidden)
        fit = Fit(seen, lifted, default_figure(), _lens(seen, FOCAL, None), None)
        for _ in range(8):
            fit.advance(Stage(1, surface=True))
        pixels, _ = project(mark_points(fit.state, fit.state.posed(fit.figure), fit.marks), fit.state, fit.lens)
        errors.append(np.linalg.norm(pixels[:, ankle] - few.keypoints_px[:, ankle], axis=-1).mean())
    assert errors[1] < 4 < errors[0]


def test_a_frame_out_of_place_is_told_by_what_others_show(person):
    few, lifted = person[0].select(np.arange(8)), parts_of(person[1], 8)
    fit = Fit(few, lifted, default_figure(), _lens(few, FOCAL, None), None)
    for _ in range(8):
        fit.advance(Stage(1, surface=True))
    astray, aside_m = 3, 0.02
    gaps = []
    for shift in (0.0, aside_m):
        translations = fit.state.translations.copy()
        translations[astray, 0] += shift
        state = replace(fit.state, translations=translations)
        posed = state.posed(fit.figure)
        term = appearance_term(fit.surface, state, posed, fit.lens, few.person, 1.0)
        seen = fit.surface.seen(state, posed, fit.lens, term.vertices).pixels
        gaps.append(np.median((term.pixels - seen)[astray, term.inverse[astray] > 0], axis=0))
    pixels = aside_m * FOCAL / -fit.state.posed(fit.figure).joints[astray, 0, 2]
    np.testing.assert_allclose(gaps[1] - gaps[0], [-pixels, 0], atol=0.25 * pixels)


def test_outlines_lie_so_far_outside_of_the_vertices_they_are_matched_with(person):
    observations, lifted = person[:2]
    wide = 4 * SIZE
    fit = Fit(observations, lifted, default_figure(), _lens(observations, FOCAL, None), None)
    fit.state = replace(fit.state, log_focal=fit.state.log_focal + np.log(4))
    fit.lens = replace(fit.lens, centre=4 * fit.lens.centre)
    posed = fit.state.posed(fit.figure)
    masks = []
    for frame in range(FRAMES):
        pixels, _ = project(fit.surface.whole(fit.state, posed, frame), fit.state, fit.lens)
        masks.append(np.zeros((wide, wide), np.uint8))
        for triangle in (pixels[fit.figure.body.faces] * 16).astype(np.int32):
            cv2.fillConvexPoly(masks[-1], triangle, 255, shift=4)
    fit.outlines = outlines_of(masks, FRAMES, (wide, wide))
    term = fit._outline_term()
    seen = fit.surface.seen(fit.state, posed, fit.lens, np.maximum(term.matches, 0)).pixels
    inside = ((term.outlines.points - seen) * term.outlines.normals).sum(-1) / fit._scale()[:, None]
    assert inside[term.matches >= 0].mean() == pytest.approx(INSET_M, abs=0.002)


def test_flow_over_more_frames_than_there_are_says_nothing(person):
    few, lifted = person[0].select(np.arange(4)), parts_of(person[1], 4)
    few = replace(few, flow=(Flow(8, np.zeros((0, 4)), np.zeros((0, CELLS, CELLS, 2), np.float16)),))
    fit = Fit(few, lifted, default_figure(), _lens(few, 240.0, None), 1.7)
    assert np.isfinite(fit.advance(Stage(1, surface=True)))


def test_equations_are_solved_as_dense_ones():
    rng = np.random.default_rng(1)
    frames, unknowns, shared = 5, 3, 2
    equations = NormalEquations(frames, unknowns, shared)
    rows: list[np.ndarray] = []
    right: list[float] = []

    def note(parts: dict[int, np.ndarray], common: np.ndarray, value: float, weight: float) -> None:
        row = np.zeros(frames * unknowns + shared)
        for frame, part in parts.items():
            row[frame * unknowns : (frame + 1) * unknowns] = part
        row[frames * unknowns :] = common
        rows.append(row * np.sqrt(weight))
        right.append(value * np.sqrt(weight))

    residual, weight = rng.normal(size=(frames, 8)), rng.uniform(0.5, 2, (frames, 8))
    local, common = rng.normal(size=(frames, 8, unknowns)), rng.normal(size=(frames, 8, shared))
    equations.add(residual, weight, local, common)
    for t in range(frames):
        for m in range(8):
            note({t: local[t, m]}, common[t, m], residual[t, m], weight[t, m])
    chained, kept = rng.normal(size=(frames - 2, 4)), rng.uniform(0.5, 2, (frames - 2, 4))
    parts = [rng.normal(size=(frames - 2, 4, unknowns)) for _ in range(3)]
    equations.add_chain(chained, kept, parts)
    for t in range(frames - 2):
        for m in range(4):
            note({t + k: parts[k][t, m] for k in range(3)}, np.zeros(shared), chained[t, m], kept[t, m])
    found_local, found_shared = equations.solve(0.0)
    expected = -np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([found_local.ravel(), found_shared]), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "said"),
    [({"height": 17.0}, "--height"), ({"focal_px": -1.0}, "focal length"), ({"few": 8}, "frames of the person")],
)
def test_refusals(person, options, said):
    observations = person[0]
    if "few" in options:
        observations = observations.select(np.arange(options.pop("few")))
    with pytest.raises(InputError, match=said):
        estimate(observations, **options)
