"""Checkpoints: round trip, and refusal of broken files."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from rnd_runtime.core.errors import InputError
from rnd_trainer.config import TrainConfig, from_dict, preset, to_dict
from rnd_trainer.model import checkpoint as checkpoints
from rnd_trainer.model.checkpoint import load_checkpoint, read_tensors, write_tensors


def test_a_checkpoint_rebuilds_the_same_model(tiny_checkpoint) -> None:
    first, second = load_checkpoint(tiny_checkpoint), load_checkpoint(tiny_checkpoint)
    encoded = first.model.encoded_nodes()
    assert torch.equal(first.model.attributes(encoded).albedo, second.model.attributes(encoded).albedo)
    assert first.info["body_license"] == "CC0-1.0"
    assert first.skeleton.names[0] == "pelvis"


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused(tiny_checkpoint, tmp_path, share) -> None:
    whole = tiny_checkpoint.read_bytes()
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cut\.ckpt: not a whole safetensors file"):
        load_checkpoint(cut)


def _rewritten(path, target, change_header=lambda h: h, change_tensors=lambda t: t):
    tensors, header = read_tensors(path, checkpoints.SCHEMA)
    write_tensors(target, change_tensors(tensors), change_header(header))
    return target


def test_a_newer_schema_is_refused(tiny_checkpoint, tmp_path) -> None:
    path = _rewritten(tiny_checkpoint, tmp_path / "new.ckpt", lambda h: h | {"schema": "rnd-checkpoint/9"})
    with pytest.raises(InputError, match="schema: expected rnd-checkpoint/1, got rnd-checkpoint/9"):
        load_checkpoint(path)


def test_a_missing_tensor_and_a_nan_are_refused(tiny_checkpoint, tmp_path) -> None:
    path = _rewritten(
        tiny_checkpoint,
        tmp_path / "less.ckpt",
        change_tensors=lambda t: {k: v for k, v in t.items() if k != "model.points"},
    )
    with pytest.raises(InputError, match="not an avatar checkpoint"):
        load_checkpoint(path)
    path = _rewritten(
        tiny_checkpoint, tmp_path / "nan.ckpt", change_tensors=lambda t: t | {"probe": t["probe"] * float("nan")}
    )
    with pytest.raises(InputError, match="expected finite numbers"):
        load_checkpoint(path)


def test_neighbours_out_of_range_are_refused(tiny_checkpoint, tmp_path) -> None:
    path = _rewritten(
        tiny_checkpoint,
        tmp_path / "far.ckpt",
        change_tensors=lambda t: t | {"model.interpolate.neighbours": t["model.interpolate.neighbours"] + 10**6},
    )
    with pytest.raises(InputError, match="out of range"):
        load_checkpoint(path)


def test_other_files_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="checkpoint not found"):
        load_checkpoint(tmp_path / "nowhere.ckpt")
    pickled = tmp_path / "pickled.ckpt"
    pickled.write_bytes(b"\x80\x04cos\nsystem\n(S'touch /tmp/owned'\ntR.")
    with pytest.raises(InputError, match="not a whole safetensors file"):
        load_checkpoint(pickled)


def test_configuration_survives_json_and_an_earlier_version_and_refuses_unknown_fields() -> None:
    config = preset("quick")
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    with pytest.raises(InputError, match="weight_lipps"):
        from_dict(to_dict(config) | {"weight_lipps": 1.0})
    earlier = to_dict(config)
    del earlier["weight_light_sky"], earlier["model"]["learned_normals"]
    assert from_dict(earlier) == config
    with pytest.raises(InputError, match="preset: expected quick, standard or full, got slow"):
        preset("slow")


def test_presets_differ_in_schedule_only() -> None:
    standard, full = preset("standard"), preset("full")
    schedule = {name: getattr(standard, name) for name in ("steps", "rate_final", "rate_cooled")}
    assert dataclasses.replace(full, **schedule) == standard == TrainConfig()
    assert full.steps == 5 * standard.steps
