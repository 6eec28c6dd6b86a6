"""The exported graph against torch, and what must not be in the file."""

from __future__ import annotations

import dataclasses

import numpy as np
import onnx
import pytest
import torch

from rnd_export import export as exports
from rnd_export.export import MAX_POSITION_ERROR_M, MAX_WEIGHT_ERROR, export, measure_drift, random_motion
from rnd_runtime.avatar import Avatar
from rnd_runtime.errors import InputError
from rnd_trainer.checkpoint import load_checkpoint, save_checkpoint
from rnd_trainer.model import AvatarModel
from rnd_trainer.template import sample_template
from tiny import body, motion


def test_onnxruntime_says_what_torch_says(tiny_avatar, tiny_checkpoint) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    moves = random_motion(checkpoint.skeleton, frames=60, seed=3)
    drift = measure_drift(Avatar.load(tiny_avatar), checkpoint, moves)
    assert drift.weights < MAX_WEIGHT_ERROR / 10
    assert drift.position_m < MAX_POSITION_ERROR_M / 10
    assert drift.normal < 1e-4 and drift.visibility < 1e-4
    assert drift.covariance_relative < 1e-4


def test_the_same_checkpoint_gives_the_same_bytes(tiny_avatar, tiny_checkpoint, tmp_path) -> None:
    export(tiny_checkpoint, tmp_path / "again.onnx")
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
    assert "skinning/temporal/cross_scores" in names


def test_nothing_stays_when_the_drift_is_too_large(tiny_checkpoint, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(exports, "MAX_WEIGHT_ERROR", 0.0)
    with pytest.raises(InputError, match="export refused: skinning weights of onnxruntime and torch differ"):
        export(tiny_checkpoint, tmp_path / "avatar.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_static_avatar_exports_too(tiny_checkpoint, tmp_path) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    model_config = dataclasses.replace(checkpoint.config.model, dynamic_skinning=False)
    config = dataclasses.replace(checkpoint.config, model=model_config)
    model = AvatarModel(model_config, sample_template(body(), 800, 200, seed=1))
    path = tmp_path / "static.ckpt"
    save_checkpoint(path, model, torch.ones(32, 64, 3), checkpoint.skeleton, config, {})
    drift = export(path, tmp_path / "static.onnx", motion(body()))
    assert drift.frames == 6 and drift.weights < 1e-6


def test_bones_alone_move_an_avatar_rigidly(tiny_avatar) -> None:
    avatar = Avatar.load(tiny_avatar)
    window = np.tile(np.array([1, 0, 0, 0, 1, 0]), (avatar.window_poses, 23, 1))
    bones = np.tile(np.eye(3, 4), (24, 1, 1))
    still = avatar.run((window, np.zeros((23, 3)), bones), ["means"])[0]
    bones[:, :, 3] = [1.0, 2.0, 3.0]
    moved = avatar.run((window, np.zeros((23, 3)), bones), ["means"])[0]
    assert np.abs(moved - still - [1, 2, 3]).max() < 1e-5
