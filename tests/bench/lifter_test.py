"""``rnd-bench study lifter``: motions, bodies, the errors of landmarks, likelihood, training, figures."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from rnd_bench.cli import main
from rnd_bench.lifter import errors as err
from rnd_bench.lifter.figures import Lifts, calibration, figures, procrustes, synthetic
from rnd_bench.lifter.motions import MIRROR, TEST, VALIDATION, Clips, chained, load_clips, relative, sampled, subject_of
from rnd_bench.lifter.network import export, negative_log_likelihood
from rnd_bench.lifter.pose2sim import Calibrated, triangulated
from rnd_bench.lifter.refining import loss_of, refine
from rnd_bench.lifter.solving import solve
from rnd_bench.lifter.synthesis import batch, strided, vectors_of
from rnd_bench.lifter.views import positions, sampled_cameras, sampled_offsets
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import JOINTS, REST_DIRECTIONS, ROLL_AXES
from rnd_trainer.estimating.lifter import CHANNELS, REACH, run
from rnd_trainer.estimating.observations import BLAZEPOSE
from support.paths import SHARED

VALUES = 33 * 6


@pytest.fixture(scope="module")
def clips() -> Clips:
    """Three clips of smooth, random motion."""
    rng = np.random.default_rng(0)
    phases = rng.uniform(0, 2 * np.pi, (3, 1, 22, 3))
    waves = 0.4 * np.sin(phases + np.arange(90)[:, None, None] * 0.1)
    rotations = chained(axis_angle_to_matrix(waves).astype(np.float32)).reshape(-1, 22, 3, 3)
    return Clips(
        rotations, np.full((270, 3), [0, 1, 0], np.float32), np.array([0, 90, 180]), np.array([90] * 3), ("a", "b", "c")
    )


@pytest.fixture(scope="module")
def model() -> err.ErrorModel:
    """Errors of 1 cm in 2D and 3 cm in 3D, independent of the pose, and offsets of 5 cm."""
    rng = np.random.default_rng(1)
    rest = np.r_[np.full(66, 0.01), np.full(99, 0.03), np.full(33, 0.5)]
    predictors = err._predictors(np.ones((1, 33, 3), np.float32)).shape[1]
    mean = np.zeros((predictors, VALUES))
    mean[99, 165:] = 6.0  # the constant is a half: logits of 3
    offsets = rng.normal(0, 0.03, (33, 3))
    offsets = (offsets + offsets[err.SWAPPED] * [-1, 1, 1]) / 2
    return err.ErrorModel(
        offsets, mean, np.zeros((VALUES, err.FACTORS)), rest, np.full(VALUES, 0.3), np.full(VALUES, 0.8), np.zeros(33)
    )


def test_rotations_relative_to_parents_chain_back(clips: Clips) -> None:
    local = relative(clips.rotations[:5])
    np.testing.assert_allclose(chained(local), clips.rotations[:5], atol=1e-5)


def test_windows_are_rotations_and_mirror_images_swap_the_sides(clips: Clips) -> None:
    rotations, _ = sampled(clips, 40, 30, np.random.default_rng(2))
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, -1, -2), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-5
    )
    assert (MIRROR[MIRROR] == np.arange(22)).all() and JOINTS[MIRROR[1]] == "right_hip"


def test_subjects_of_the_held_out_parts_are_in_no_other() -> None:
    if not (SHARED / "data" / "mocap").is_dir():
        pytest.skip("no motions in ../shared/data/mocap")
    parts = load_clips(SHARED / "data" / "mocap")
    subjects = {part: {subject_of(name.split("/")[1]) for name in clips.names} for part, clips in parts.items()}
    assert subjects["test"] == set(TEST) and subjects["validation"] == set(VALIDATION)
    assert not subjects["train"] & (subjects["test"] | subjects["validation"])
    assert sum(len(clips.names) for clips in parts.values()) == 383


def test_vectors_of_the_t_pose_are_the_rest_vectors() -> None:
    vectors = vectors_of(np.broadcast_to(np.eye(3, dtype=np.float32), (22, 3, 3)))
    np.testing.assert_allclose(vectors, np.concatenate([REST_DIRECTIONS, ROLL_AXES]), atol=1e-6)


@pytest.mark.parametrize("kappa", [0.5, 3.0, 40.0, 2000.0])
def test_likelihood_integrates_to_one(kappa: float) -> None:
    cosine = 1 - np.logspace(-9, np.log10(2.0), 20001)
    target = torch.tensor(np.stack([np.sqrt(np.maximum(1 - cosine**2, 0)), 0 * cosine, cosine], -1))
    mean = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(target)
    density = torch.exp(
        -negative_log_likelihood(mean, torch.full((len(target),), kappa, dtype=torch.float64), target)
    ).numpy()
    assert np.trapezoid(density, 1 - cosine) == pytest.approx(1, abs=2e-3)  # 2π of the ring and of the constant cancel


def test_offsets_and_errors_are_found_again(clips: Clips, model: err.ErrorModel) -> None:
    rng = np.random.default_rng(3)
    windows = []
    for _ in range(30):
        rotations, roots = sampled(clips, 1, 24, rng, augment=False)
        joints = positions(rotations, roots, sampled_offsets(1, rng))
        cameras = sampled_cameras(joints, rng)
        rotations, seen = (cameras.rotations[:, None, None] @ rotations), cameras.seen(joints)
        rays, confidence, hint = err.seen_with_errors(err.landmarks(rotations, seen, model.offsets), model, rng)
        names = ("rays", "confidence", "hint_m", "rotations", "joints")
        windows.append(dict(zip(names, (a[0, ::2] for a in (rays, confidence, hint, rotations, seen)))))
    found = err.fit_errors(windows)
    hips = [BLAZEPOSE.index(n) for n in ("left_hip", "right_hip", "left_knee", "left_wrist", "nose")]
    assert np.abs(found.offsets[hips] - model.offsets[hips]).max() < 0.012
    deviation = np.sqrt((found.factors**2).sum(1) + found.rest**2)
    assert 0.006 < np.median(deviation[:66]) < 0.014 and 0.018 < np.median(deviation[66:165]) < 0.04


def test_strided_values_keep_the_frames_of_the_video() -> None:
    values = np.random.default_rng(4).normal(size=(13, 2)).astype(np.float32)
    kept = strided(values, 3)
    np.testing.assert_allclose(kept[::3], values[::3], atol=1e-6)
    np.testing.assert_allclose(kept[1], values[0] * 2 / 3 + values[3] / 3, atol=1e-6)


@pytest.fixture(scope="module")
def solved(clips: Clips, model: err.ErrorModel, tmp_path_factory):
    """A small network solved on two batches, and its file."""
    network = solve(clips, model, 2, lambda done: None, hidden=64)
    file = tmp_path_factory.mktemp("lifter") / "lifter.onnx"
    export(network, file)
    return network, file


def test_the_solved_network_beats_the_landmarks_and_knows_its_errors(
    clips: Clips, model: err.ErrorModel, solved
) -> None:
    row = figures(synthetic(clips, model, solved[1], batches=1))
    assert row["frames"] == 24 * 60 and len(row["bones_deg"]) == 21
    assert row["limbs_deg"] < 0.9 * row["limbs_deg_landmarks"]
    for decile in row["calibration"][2:-2]:
        assert 0.5 < decile["actual_deg"] / decile["predicted_deg"] < 2


def test_refining_lowers_the_loss_and_is_reproducible(clips: Clips, model: err.ErrorModel, solved) -> None:
    made = batch(clips, model, 20, 24 + 2 * REACH, np.random.default_rng(9))
    with torch.no_grad():
        before = float(loss_of(solved[0], made))
    first, again = (refine(copy.deepcopy(solved[0]), clips, model, 6, lambda step, loss: None) for _ in range(2))
    with torch.no_grad():
        assert float(loss_of(first, made)) < before
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters()))


def test_the_file_computes_what_the_network_does(solved) -> None:
    network, file = copy.deepcopy(solved[0]), solved[1]
    for weight in network.parameters():  # the file holds matrices in half precision
        if weight.ndim == 2:
            weight.data = weight.data.half().float()
    inputs = np.random.default_rng(8).normal(size=(2, 9, CHANNELS)).astype(np.float32)
    unit, kappa = run(inputs, file)
    padded = torch.from_numpy(np.pad(inputs, ((0, 0), (REACH, REACH), (0, 0)), mode="edge"))
    with torch.no_grad():
        expected, concentration = network(padded)
    np.testing.assert_allclose(unit, expected.numpy(), atol=2e-4)
    np.testing.assert_allclose(np.log(kappa), concentration.log().numpy(), atol=2e-3)


def test_calibration_of_exact_deviations_is_level() -> None:
    rng = np.random.default_rng(5)
    deviation = rng.uniform(0.02, 0.3, (4000, 42))
    tangent = rng.normal(size=(4000, 42, 2)) * deviation[..., None]
    angle = np.linalg.norm(tangent, axis=-1, keepdims=True)
    target = np.concatenate([np.sinc(angle / np.pi) * tangent, np.cos(angle)], -1).astype(np.float32)
    unit = np.broadcast_to(np.float32([0, 0, 1]), target.shape)
    rows = calibration(
        Lifts(
            unit,
            (1 / deviation**2).astype(np.float32),
            target,
            np.zeros((4000, 33, 3), np.float32),
            np.ones((4000, 21), np.float32),
        )
    )
    for row in rows:
        assert row["actual_deg"] == pytest.approx(row["predicted_deg"], rel=0.05)


def test_procrustes_ignores_similarities_but_no_mirror_image() -> None:
    rng = np.random.default_rng(6)
    points = rng.normal(size=(4, 12, 3))
    moved = 1.7 * points @ axis_angle_to_matrix(rng.normal(size=(4, 3))) + 3
    assert procrustes(moved, points).max() < 1e-9
    assert procrustes(points * [-1, 1, 1], points).min() > 0.2


def test_triangulation_finds_points_again() -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(2, 5, 3))
    turns = axis_angle_to_matrix(rng.normal(size=(3, 3)) * 0.4)
    cameras = [Calibrated(turn, np.array([0, 0, 6.0]), np.eye(3), np.zeros(4)) for turn in turns]
    seen = np.stack([points @ c.rotation.T + c.translation for c in cameras])
    found = triangulated(cameras, seen[..., :2] / seen[..., 2:], np.ones((3, 2, 5)))
    np.testing.assert_allclose(found, points, atol=1e-9)


def test_no_batches_are_refused(tmp_path, capsys) -> None:
    folders = ["--motions", "a", "--capture", "b", "--video", "c"]
    assert main(["study", "lifter", str(tmp_path / "out"), *folders, "--batches", "0"]) == 2
    assert "--batches: expected at least 1, got 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
