"""The exported graph against torch, and what must not be in the file."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from rnd_export import export as exports
from rnd_export import parity
from rnd_export.bake import bake
from rnd_export.export import build
from rnd_export.order import order_gaussians
from rnd_export.parity import MAX_P99_M, MAX_POSITION_ERROR_M, MAX_WEIGHT_ERROR, measure_parity, random_motion
from rnd_export.reduce.variant import Variant, line_through, reduced
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import POSED_OUTPUTS, read_metadata
from rnd_runtime.avatar.onnx_parts import OnnxFile
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.posing.window import motion_window
from rnd_trainer.model.checkpoint import SCHEMA, load_checkpoint, read_tensors, save_checkpoint, write_tensors
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.model.template import sample_template, z_curve_order
from rnd_trainer.training.data import pose_input
from support.tiny import body, motion

export = functools.partial(exports.export, cull=-1)  # tests/culling_test.py is about the other part


def test_onnxruntime_agrees_with_torch(tiny_avatar, tiny_checkpoint) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    moves = random_motion(checkpoint.skeleton, frames=60, seed=3)
    error = measure_parity(Avatar.load(tiny_avatar), checkpoint, moves, _rows(checkpoint))
    assert error.weights < MAX_WEIGHT_ERROR / 10
    assert error.position_m < MAX_POSITION_ERROR_M / 10
    assert error.normal < 1e-4 and error.visibility < 1e-4
    assert error.covariance_relative < 1e-4


def _rows(checkpoint) -> np.ndarray:
    """The model's Gaussians in the file's order."""
    return order_gaussians(bake(checkpoint.model)).rows


def test_neighbours_on_the_body_are_neighbours_in_the_file(tiny_avatar, tiny_checkpoint) -> None:
    model = load_checkpoint(tiny_checkpoint).model
    nodes, points = model.config.nodes, model.points.numpy()
    rows = _rows(load_checkpoint(tiny_checkpoint))
    assert (np.sort(rows) == np.arange(len(points))).all()
    apart = [np.linalg.norm(np.diff(p, axis=0), axis=1).mean() for p in (points, points[rows])]
    assert apart[1] < 0.2 * apart[0]
    rest = Avatar.load(tiny_avatar)._rest  # nodes too: sixteen Gaussians in a row read few of them
    used = [len(np.unique(some)) for some in np.array_split(rest.neighbours, len(points) // 16)]
    spans = [int(np.ptp(some)) for some in np.array_split(rest.neighbours, len(points) // 16)]
    assert np.median(used) < 32 and np.median(spans) < nodes / 2  # measured 17 and 58; of any order 55 and 195


def test_the_same_checkpoint_gives_the_same_bytes(tiny_avatar, tiny_checkpoint, tmp_path) -> None:
    exports.export(load_checkpoint(tiny_checkpoint), tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == tiny_avatar.read_bytes()


def test_the_file_is_plain_onnx(tiny_avatar) -> None:
    model = onnx.load(tiny_avatar)
    onnx.checker.check_model(model, full_check=True)
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 18)]
    assert {node.domain for node in model.graph.node} == {""}
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    assert b"/work" not in tiny_avatar.read_bytes() and b".py" not in tiny_avatar.read_bytes()
    names = [node.name for node in model.graph.node]
    assert len(set(names)) == len(names)
    assert "skinning/cross_scores" in names


def test_nothing_stays_when_the_drift_is_too_large(tiny_checkpoint, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(parity, "MAX_WEIGHT_ERROR", 0.0)
    with pytest.raises(InputError, match="export refused: skinning weights of onnxruntime and torch differ"):
        export(load_checkpoint(tiny_checkpoint), tmp_path / "avatar.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_static_avatar_exports_too(tiny_checkpoint, tmp_path) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    model_config = dataclasses.replace(checkpoint.config.model, dynamic_skinning=False)
    config = dataclasses.replace(checkpoint.config, model=model_config)
    model = AvatarModel(model_config, sample_template(body(), 800, 200, seed=1))
    path = tmp_path / "static.ckpt"
    save_checkpoint(path, model, {"white": torch.ones(32, 64, 3)}, checkpoint.skeleton, config, {})
    error = export(load_checkpoint(path), tmp_path / "static.onnx", motion(body()))
    assert error.frames == 6 and error.weights < 1e-6


def test_bones_alone_move_an_avatar_rigidly(tiny_avatar) -> None:
    avatar = Avatar.load(tiny_avatar)
    window = np.tile(np.array([1, 0, 0, 0, 1, 0]), (avatar.window_poses, 23, 1))
    bones = np.tile(np.eye(3, 4), (24, 1, 1))
    still = avatar.run((window, np.zeros((23, 3)), bones), ["means"])[0]
    bones[:, :, 3] = [1.0, 2.0, 3.0]
    moved = avatar.run((window, np.zeros((23, 3)), bones), ["means"])[0]
    assert np.abs(moved - still - [1, 2, 3]).max() < 1e-5


@pytest.mark.parametrize("precision", ["f16", "int8"])
def test_fewer_bits_make_a_smaller_file_that_drifts_little(tiny_checkpoint, tiny_avatar, tmp_path, precision) -> None:
    out = tmp_path / "small.onnx"
    error = export(load_checkpoint(tiny_checkpoint), out, motion(body()), Variant(precision=precision))
    assert error.position_m > MAX_POSITION_ERROR_M / 10 and error.position_p99_m < MAX_P99_M[precision] / 2
    assert out.stat().st_size < 0.8 * tiny_avatar.stat().st_size
    assert Avatar.load(out).metadata.variant.precision == precision
    first = out.read_bytes()
    export(load_checkpoint(tiny_checkpoint), out, motion(body()), Variant(precision=precision))
    assert out.read_bytes() == first


def test_precision_is_refused_where_it_costs_too_much(tiny_checkpoint, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(MAX_P99_M, "int8", 1e-6)
    with pytest.raises(InputError, match=r"positions \(99 %\) of onnxruntime and torch differ"):
        export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body()), Variant(precision="int8"))
    assert list(tmp_path.iterdir()) == []


def test_coarse_is_the_model_on_fewer_nodes(tiny_checkpoint, tmp_path) -> None:
    """With as many nodes as the checkpoint nothing changes; with fewer, the networks say the same at those."""
    checkpoint = load_checkpoint(tiny_checkpoint)
    whole, half = tmp_path / "whole.onnx", tmp_path / "half.onnx"
    error = export(load_checkpoint(tiny_checkpoint), whole, motion(body()), Variant("coarse", nodes=200))
    assert error.position_m < MAX_POSITION_ERROR_M / 10
    export(load_checkpoint(tiny_checkpoint), half, motion(body()), Variant("coarse"))
    variant = Avatar.load(half).metadata.variant
    assert (variant.encoder, variant.nodes) == ("coarse", 50)
    codes = bake(checkpoint.model).all_codes
    few, many = z_curve_order(codes[:50]), z_curve_order(codes[:200])  # the file's order of nodes
    for name in ("node_logits", "node_offsets", "node_visibility"):
        coarse, truth = (_output(path, motion(body()), checkpoint, name) for path in (half, whole))
        same, others = truth[np.argsort(many)[few]], truth[:50]
        assert np.abs(coarse - same).max() < MAX_WEIGHT_ERROR / 10 < np.abs(coarse - others).max()


@pytest.mark.parametrize(
    ("variant", "encoder", "nodes", "dynamic_nodes"),
    [
        (Variant(), "full", 200, 200),
        (Variant("coarse", nodes=100), "coarse", 100, 100),
        (Variant("static"), "static", 200, 0),
    ],
)
def test_the_metadata_states_the_nodes(variant, encoder, nodes, dynamic_nodes, tiny_checkpoint, tmp_path) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    baked = reduced(bake(checkpoint.model), checkpoint.config.model, variant)
    stated = read_metadata(OnnxFile(build(checkpoint, baked, variant).SerializeToString())).variant
    assert (stated.encoder, stated.nodes, stated.dynamic_nodes) == (encoder, nodes, dynamic_nodes)


def _weights(path, moves: Motion, checkpoint) -> np.ndarray:
    return _output(path, moves, checkpoint, "skinning_weights")


def _output(path, moves: Motion, checkpoint, name: str) -> np.ndarray:
    pose = pose_input(moves, checkpoint.skeleton, 0.1, checkpoint.config.model)
    inputs = (pose.window.numpy(), pose.velocity.numpy(), pose.bones.numpy())
    return Avatar.load(path).run(inputs, [name])[0]


def test_static_is_the_template(tiny_checkpoint, tmp_path) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body()), Variant("static"))
    template = checkpoint.model.log_weights.softmax(-1).numpy()
    weights = _weights(tmp_path / "a.onnx", motion(body()), checkpoint)
    template = template[_rows(checkpoint)]
    assert np.abs(weights - template).max() < MAX_WEIGHT_ERROR / 10
    names = {node.name for node in onnx.load(tmp_path / "a.onnx").graph.node}
    assert not any("temporal" in name for name in names)


def test_a_shorter_window_sees_a_steady_motion_alike(tiny_checkpoint, tmp_path) -> None:
    """Poses on a line in 6D are what the interpolation assumes: a still figure is on one."""
    checkpoint = load_checkpoint(tiny_checkpoint)
    still = dataclasses.replace(motion(body()), rotations=motion(body()).rotations[[3] * 6])
    error = export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", still, Variant(window_poses=2))
    assert error.position_m < MAX_POSITION_ERROR_M / 10
    assert Avatar.load(tmp_path / "a.onnx").window_poses == 2
    moves = random_motion(checkpoint.skeleton, frames=4, seed=0)
    moving = export(checkpoint, tmp_path / "a.onnx", moves, Variant(window_poses=2))
    assert moving.position_m > error.position_m
    assert np.allclose(line_through(5, 3), [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]])


def test_a_lower_degree_drops_the_higher_harmonics(tiny_checkpoint, tiny_avatar, tmp_path) -> None:
    export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body()), Variant(visibility_degree=1))
    less, whole = (Avatar.load(p).pose(motion(body()), 0.1).visibility for p in (tmp_path / "a.onnx", tiny_avatar))
    assert np.abs(less[:, :4] - whole[:, :4]).max() < 1e-5
    assert (less[:, 4:] == 0).all() and np.abs(whole[:, 4:]).max() > 0.01


def test_of_a_long_motion_some_frames_are_compared_the_last_one_too(tiny_checkpoint, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("rnd_export.parity.MAX_FRAMES", 4)
    checkpoint, seen = load_checkpoint(tiny_checkpoint), []
    original = checkpoint.model.forward
    monkeypatch.setattr(checkpoint.model, "forward", lambda pose: seen.append(pose) or original(pose))
    moves = motion(body(), 31)
    error = export(checkpoint, tmp_path / "a.onnx", moves)
    last = pose_input(moves, checkpoint.skeleton, 30 / moves.fps, checkpoint.config.model)
    assert error.frames == 4 == len(seen) and torch.equal(seen[-1].bones, last.bones)


def test_a_body_of_alike_weights_is_exported(tiny_checkpoint, tmp_path) -> None:
    """As of one joint: the template's logarithms are all the smallest."""
    checkpoint = load_checkpoint(tiny_checkpoint)
    checkpoint.model.log_weights.fill_(-math.log(checkpoint.model.log_weights.shape[1]))
    assert export(checkpoint, tmp_path / "a.onnx", motion(body(), 2)).position_m < 1e-4


@pytest.mark.parametrize("what", ("normals", "visibility", "covariances"))
def test_a_file_that_poses_otherwise_is_refused(what, tiny_checkpoint, tmp_path, monkeypatch) -> None:
    run = Avatar.run

    def bent(self: Avatar, inputs: object, names: tuple[str, ...]) -> list[np.ndarray]:
        return [1.01 * a if name == what else a for name, a in zip(names, run(self, inputs, names))]

    monkeypatch.setattr(Avatar, "run", bent)
    with pytest.raises(InputError, match=f"export refused: {what} of onnxruntime and torch differ"):
        export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body(), 2))


@pytest.mark.parametrize(
    ("variant", "line"),
    [
        (Variant("coarse", nodes=201), "--nodes: expected 4 to 200, got 201"),
        (Variant(nodes=100), "--nodes: expected --encoder coarse, got --encoder full"),
        (Variant("static", window_poses=3), "--window-poses: expected dynamic skinning, got the template's weights"),
        (Variant(window_poses=6), "--window-poses: expected 2 to 5, got 6"),
        (Variant(visibility_degree=4), "--visibility-degree: expected 0 to 3, got 4"),
    ],
)
def test_what_no_file_can_be_is_refused(tiny_checkpoint, tmp_path, variant, line) -> None:
    with pytest.raises(InputError, match=line):
        export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", variant=variant)
    assert list(tmp_path.iterdir()) == []


def test_constants_are_unpacked_when_the_file_is_loaded_not_at_every_frame(tiny_checkpoint, tmp_path) -> None:
    """onnxruntime's own optimised graph: nothing is left of what depends on no input."""
    export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body()), Variant(precision="f16"))
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    ort.InferenceSession(tmp_path / "a.onnx", options, providers=["CPUExecutionProvider"])
    kinds = {node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node}
    assert not kinds & {"Cast", "ScatterElements", "CumSum", "ConstantOfShape", "Sin", "Cos"}


@pytest.mark.parametrize(
    "variant", [Variant(), Variant("static", "int8", visibility_degree=2), Variant("coarse", "f16")]
)
def test_the_compiled_posing_agrees_with_the_graph(tiny_checkpoint, tmp_path, variant) -> None:
    export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", motion(body()), variant)
    avatar, moves, time = Avatar.load(tmp_path / "a.onnx"), motion(body()), 0.1
    assert {"node_offsets", "rest_limbs", "neighbours"} <= {o.name for o in onnx.load(tmp_path / "a.onnx").graph.output}
    window, velocity = motion_window(moves, time, poses=avatar.window_poses, seconds=avatar.window_seconds)
    now = moves.at(np.array([time]))
    bones = bone_transforms(avatar.skeleton, now.rotations[0], now.translations[0])
    posed = avatar.pose(moves, time)
    for name, value in zip(POSED_OUTPUTS, avatar.run((window, velocity, bones), POSED_OUTPUTS)):
        ours = getattr(posed, name)
        assert np.abs(ours - value).max() < 1e-5 * max(1.0, np.abs(value).max()), name


def test_ablations_are_not_exported(tiny_checkpoint, tmp_path) -> None:
    tensors, header = read_tensors(tiny_checkpoint, SCHEMA)
    header["config"]["model"]["visibility"] = "paper"
    write_tensors(tmp_path / "paper.ckpt", tensors, header)
    with pytest.raises(InputError, match="an ablation, which is not exported: visibility: expected pose, got paper"):
        export(load_checkpoint(tmp_path / "paper.ckpt"), tmp_path / "paper.onnx")
    assert not (tmp_path / "paper.onnx").exists()
