"""``rnd-bench study lifter``: motions, people on film, the landmark network in torch, likelihood, training, figures."""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from rnd_bench.cli import main
from rnd_bench.lifter import filming, training
from rnd_bench.lifter.blazepose import LandmarkGraph
from rnd_bench.lifter.figures import Lifts, calibration, procrustes
from rnd_bench.lifter.filming import Films, Places, Studio, Window, filmed, load_films, save_films
from rnd_bench.lifter.motions import MIRROR, Clips, chained, relative, sampled
from rnd_bench.lifter.network import export, negative_log_likelihood
from rnd_bench.lifter.people import Points
from rnd_bench.lifter.pose2sim import Calibrated, triangulated
from rnd_bench.lifter.training import between, samples_of, train, vectors_of
from rnd_runtime.avatar.inference import open_session
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import JOINTS, REST_DIRECTIONS, ROLL_AXES
from rnd_trainer.estimating.lifter import CHANNELS, REACH, run
from rnd_trainer.estimating.observing.regions import Region
from support.tiny import body

CPU = torch.device("cpu")


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
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person's file: the tests' body in one colour."""
    one = body()
    held = np.argsort(-one.skinning_weights, 1)[:, :4]
    file = tmp_path_factory.mktemp("people") / "one.npz"
    np.savez(
        file,
        vertices=one.vertices,
        faces=one.faces,
        joints=held,
        weights=np.take_along_axis(one.skinning_weights, held, 1),
        colour=np.full((len(one.vertices), 3), 0.5),
        piece=np.zeros(len(one.vertices), np.uint8),
        rest=one.skeleton.rest_joints,
    )
    return file


class Graph:
    """Sees every point in the middle of its crop, and the person's circle as it is."""

    def __call__(self, crops: torch.Tensor) -> list[torch.Tensor]:
        count = len(crops)
        rows = torch.full((count, 39, 5), 128.0)
        rows[:, 34, 1] = 128 - 256 / 2.5
        rows[..., 3:] = 9.0
        metres = torch.zeros(count, 39, 3)
        return [rows.flatten(1), torch.ones(count, 1), crops, torch.full((count, 39, 64, 64), -9.0), metres.flatten(1)]


@pytest.fixture(scope="module")
def studio(person: Path) -> Studio:
    """A studio without network, under even light."""
    studio = Studio.__new__(Studio)
    studio.device, studio.graph = CPU, Graph()
    studio.files, studio.places = [person], Places(torch.full((1, 3, 8, 16), 0.2), torch.ones(1, 3, 4, 8))
    studio._people = {person: Points.load(person, 4000, CPU)}
    return studio


def _windows(clips: Clips, count: int, seed: int) -> list[Window]:
    """Windows in which the network's 3D is the truth in the camera's axes and its 2D fits it."""
    rng = np.random.default_rng(seed)
    rotations, _ = sampled(clips, count, 20, rng)
    names = ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist")
    joints = np.zeros((count, 20, 22, 3), np.float32)
    for bone, parent in enumerate(training._UP):
        joints[:, :, bone + 1] = joints[:, :, parent] + 0.3 * vectors_of(rotations)[:, :, bone]
    hint = np.repeat(joints[:, :, :1], 33, 2)
    places = {11: names[0], 12: names[1], 13: names[2], 14: names[3], 15: names[4], 16: names[5]}
    legs = ("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
    for point, name in {**places, **{23 + k: name for k, name in enumerate(legs)}}.items():
        hint[:, :, point] = joints[:, :, JOINTS.index(name)]
    seen = hint + np.array([0, 0, 4.0])
    rays = (seen[..., :2] / seen[..., 2:]).astype(np.float32)
    sure, step = np.ones((20, 33), np.float32), np.float32(1)
    return [
        {
            "rays": rays[k],
            "confidence": sure,
            "hint_m": hint[k],
            "rotations": rotations[k],
            "joints": joints[k],
            "step": step,
        }
        for k in range(count)
    ]


def test_rotations_relative_to_parents_chain_back(clips: Clips) -> None:
    local = relative(clips.rotations[:5])
    np.testing.assert_allclose(chained(local), clips.rotations[:5], atol=1e-5)


def test_windows_are_rotations_and_mirror_images_swap_the_sides(clips: Clips) -> None:
    rotations, _ = sampled(clips, 40, 30, np.random.default_rng(2))
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, -1, -2), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-5
    )
    assert (MIRROR[MIRROR] == np.arange(22)).all() and JOINTS[MIRROR[1]] == "right_hip"


def test_vectors_of_the_t_pose_are_the_rest_vectors() -> None:
    vectors = vectors_of(np.broadcast_to(np.eye(3, dtype=np.float32), (22, 3, 3)))
    np.testing.assert_allclose(vectors, np.concatenate([REST_DIRECTIONS, ROLL_AXES]), atol=1e-6)


def test_points_move_as_linear_blend_skinning_says(person: Path) -> None:
    points = Points.load(person, 300, CPU)
    rng = np.random.default_rng(1)
    rotations = axis_angle_to_matrix(rng.normal(size=(2, 1, 24, 3)))
    roots = rng.normal(size=(2, 1, 3))
    shape = torch.stack([points.neutral, points.neutral + 0.5])
    turned = torch.from_numpy(rotations).float()
    joints = points.joints(shape, turned, torch.from_numpy(roots).float())
    placed, normals = points.posed(shape, turned[:, 0], joints[:, 0])
    weights = points.weights.double().numpy()
    for b in range(2):
        rest = points.rest.double().numpy() + np.tensordot(shape[b].double(), points.rest_basis.double(), 1)
        places = points.places.double().numpy() + np.tensordot(shape[b].double(), points.place_basis.double(), 1)
        local = places[:, None] - rest  # [P, 24, 3]
        moved = np.einsum("jik,pjk->pji", rotations[b, 0], local) + joints[b, 0].double().numpy()
        np.testing.assert_allclose(placed[b], (weights[..., None] * moved).sum(1), atol=1e-5)
    knee, hip = JOINTS.index("left_knee"), JOINTS.index("left_hip")
    bone = (joints[0, 0, knee] - joints[0, 0, hip]).norm()
    assert float(bone) == pytest.approx(float((points.rest[knee] - points.rest[hip]).norm()), rel=0.02)
    assert normals.shape == placed.shape


def test_regions_are_those_of_the_observer() -> None:
    centre, top = np.array([0.1, -0.2]), np.array([0.3, -0.6])
    one = Region.of_body(centre, top)
    ours = filming._region_of(torch.tensor(centre)[None], torch.tensor(top)[None])[0].numpy()
    np.testing.assert_allclose(ours, [one.x, one.y, one.size, one.rotation], atol=1e-6)
    pixels = np.random.default_rng(0).uniform(0, 256, (5, 2))
    matrix = one.to_image(256)
    found = filming._to_rays(torch.tensor(pixels)[None], torch.tensor(ours)[None].double())[0]
    np.testing.assert_allclose(found, pixels @ matrix[:, :2].T + matrix[:, 2], atol=1e-6)


def test_films_follow_the_person_and_are_stored(studio: Studio, clips: Clips, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        windows = filmed(studio, clips, 3, 5, pool, batch=2, frames=4)
    assert len(windows) == 3
    for window in windows:
        assert window["rays"].shape == (4, 33, 2) and window["joints"].shape == (4, 22, 3)
        hips = window["joints"][0, 1:3].mean(0)
        np.testing.assert_allclose(window["rays"][0, 0], hips[:2] / hips[2], atol=1e-3)
        assert window["confidence"].min() > 0.4
    save_films(tmp_path / "films.npz", windows)
    again = load_films(tmp_path / "films.npz")
    np.testing.assert_allclose(again[2]["joints"], windows[2]["joints"], atol=4e-3)


def test_frames_without_a_person_lose_the_window() -> None:
    shape = (2, 3, 4, 33)
    films = Films(
        *(np.zeros((*shape, n), np.float32) for n in (2, 3)),
        *(np.ones(shape, np.float32) for _ in range(2)),
        np.ones((2, 3), np.float32),
        np.array([[1, 1, 1], [1, 0.2, 1]], np.float32),
        *(np.zeros((2, 3, 22, *n), np.float32) for n in ((3, 3), (3,))),
        np.array([1, 2]),
    )
    assert [float(w["step"]) for w in films.windows()] == [1.0]


def test_the_network_in_torch_is_the_one_in_onnxruntime(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    shapes = {"a": (8, 3, 3, 3), "d": (8, 1, 3, 3), "e": (8, 1, 3, 3), "h": (5, 8, 4, 4), "b": (8,), "c": (5,)}
    held = {k: rng.normal(0, 0.3, s).astype(np.float32) for k, s in shapes.items()}
    held |= {"low": np.float32(0), "high": np.float32(6)}
    held |= {"sizes": np.array([1, 8, 8, 8]), "edge": np.array([0, 0, 1, 1, 0, 0, 1, 1]), "row": np.array([1, 5])}

    def conv(names: list[str], out: str, **given) -> onnx.NodeProto:
        return helper.make_node("Conv", names, [out], **({"strides": [1, 1], "dilations": [1, 1]} | given))

    nodes = [
        helper.make_node("Transpose", ["image"], ["t"], perm=[0, 3, 1, 2]),
        helper.make_node("Pad", ["t", "edge"], ["p"]),
        conv(["p", "a", "b"], "x", strides=[2, 2]),
        helper.make_node("Clip", ["x", "low", "high"], ["y"]),
        conv(["y", "d", "b"], "z", pads=[1, 1, 1, 1], group=8),
        conv(["z", "e", "b"], "s", pads=[0, 0, 1, 1], strides=[2, 2], group=8),
        helper.make_node("Resize", ["s", "", "", "sizes"], ["u"], mode="linear"),
        helper.make_node("MaxPool", ["z"], ["m"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Add", ["m", "s"], ["n"]),
        conv(["n", "h", "c"], "o", pads=[0, 0, 0, 0]),
        helper.make_node("Transpose", ["o"], ["o2"], perm=[0, 2, 3, 1]),
        helper.make_node("Reshape", ["o2", "row"], ["out"]),
        helper.make_node("Transpose", ["u"], ["up"], perm=[0, 2, 3, 1]),
    ]
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 16, 16, 3])],
        [
            helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 5]),
            helper.make_tensor_value_info("up", TensorProto.FLOAT, [1, 8, 8, 8]),
        ],
        [numpy_helper.from_array(np.asarray(array), name) for name, array in held.items()],
    )
    file = tmp_path / "small.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(file))
    image = rng.random((1, 16, 16, 3), np.float32)
    expected = open_session(file, 1).run(None, {"image": image})
    found = LandmarkGraph(file, CPU)(torch.from_numpy(image).permute(0, 3, 1, 2))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-4)
    np.testing.assert_allclose(found[1].permute(0, 2, 3, 1), expected[1], atol=1e-4)


@pytest.mark.parametrize("kappa", [0.5, 3.0, 40.0, 2000.0])
def test_likelihood_integrates_to_one(kappa: float) -> None:
    cosine = 1 - np.logspace(-9, np.log10(2.0), 20001)
    target = torch.tensor(np.stack([np.sqrt(np.maximum(1 - cosine**2, 0)), 0 * cosine, cosine], -1))
    mean = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(target)
    density = torch.exp(
        -negative_log_likelihood(mean, torch.full((len(target),), kappa, dtype=torch.float64), target)
    ).numpy()
    assert np.trapezoid(density, 1 - cosine) == pytest.approx(1, abs=2e-3)  # 2π of the ring and of the constant cancel


def test_values_between_frames_keep_those_of_the_video() -> None:
    values = np.random.default_rng(4).normal(size=(5, 2)).astype(np.float32)
    at = between(values, np.arange(13), 3)
    np.testing.assert_allclose(at[::3], values, atol=1e-6)
    np.testing.assert_allclose(at[1], values[0] * 2 / 3 + values[1] / 3, atol=1e-6)


def test_variants_of_a_window_keep_the_angle_between_landmarks_and_truth(clips: Clips) -> None:
    made = samples_of(_windows(clips, 4, 1), 0, 6)
    assert made.inputs.shape == (24, training.FRAMES, CHANNELS) and made.targets.shape == (24, training.FRAMES, 42, 3)
    start = 25 * 2 + 25 + 25 * 3
    hinted = made.inputs.astype(np.float32)[..., start : start + 36].reshape(24, training.FRAMES, 12, 3)
    target = made.targets.astype(np.float32)[..., [JOINTS.index("left_elbow") - 1], :]
    assert (hinted[:, :, :1] * target).sum(-1).min() > 0.97


@pytest.fixture(scope="module")
def trained(clips: Clips, tmp_path_factory: pytest.TempPathFactory):
    """A small network trained on a few windows, its curve, and its file."""
    with ThreadPoolExecutor(1) as pool:
        windows = _windows(clips, 24, 2)
        found = [train(windows, _windows(clips, 4, 3), 16, CPU, pool, batch=8, width=32, every=8) for _ in range(2)]
    file = tmp_path_factory.mktemp("lifter") / "lifter.onnx"
    export(found[0].network, file)
    return found, file


def test_training_lowers_the_loss_and_is_reproducible(trained) -> None:
    first, again = trained[0]
    assert first.curve[-1]["validation"] < first.curve[0]["validation"]
    assert all(torch.equal(a, b) for a, b in zip(first.network.parameters(), again.network.parameters()))


def test_the_file_computes_what_the_network_does(trained) -> None:
    network, file = copy.deepcopy(trained[0][0].network), trained[1]
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


def test_few_windows_are_refused(tmp_path, capsys) -> None:
    folders = [word for name in ("motions", "characters", "lights", "capture", "video") for word in (f"--{name}", "a")]
    assert main(["study", "lifter", str(tmp_path / "out"), *folders, "--windows", "3"]) == 2
    assert "--windows: expected at least 10, got 3" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
