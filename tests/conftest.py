"""Shared, expensive things, made once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from rnd_runtime.core.kernels import prepare_process

prepare_process()


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory):
    """A capture of six 64² pictures of the embedded body."""
    from support.tiny import write_capture

    return write_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture(scope="session")
def tiny_config():
    """A training of seconds: 600 Gaussians, 150 nodes, 12 steps in the two stages of pictures, 2 in the third."""
    from rnd_trainer.config import ModelConfig, TrainConfig

    model = ModelConfig(gaussians=600, nodes=150, width=32, attribute_width=32, window_poses=4)
    return dataclasses.replace(
        TrainConfig(),
        model=model,
        steps=12,
        stage1_fraction=0.5,
        unseen_fraction=0.15,
        light_texels=32,
        visibility_directions=4,
    )


@pytest.fixture(scope="session")
def tiny_run(tiny_capture, tiny_config, tmp_path_factory) -> Path:
    """The folder of a finished tiny training."""
    from rnd_trainer.training.run import run
    from rnd_trainer.training.training import Training

    folder = tmp_path_factory.mktemp("run")
    run(Training(tiny_capture, tiny_config), folder, on_step=lambda step: None, on_preview=lambda: None)
    return folder


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory) -> Path:
    """avatar.ckpt of an untrained model with random weights: every network says something, unlike after 14 steps."""
    import torch

    from rnd_trainer.config import ModelConfig, TrainConfig
    from rnd_trainer.model.checkpoint import save_checkpoint
    from rnd_trainer.model.model import AvatarModel
    from rnd_trainer.model.template import sample_template
    from support.tiny import body

    config = TrainConfig(model=ModelConfig(gaussians=800, nodes=200, width=32, attribute_width=32, window_poses=5))
    template = body()
    torch.manual_seed(1)
    model = AvatarModel(config.model, sample_template(template, 800, 200, seed=1))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    path = tmp_path_factory.mktemp("checkpoint") / "avatar.ckpt"
    save_checkpoint(
        path, model, {"white": torch.ones(32, 64, 3)}, template.skeleton, config, {"body_license": "CC0-1.0"}
    )
    return path


@pytest.fixture(scope="session")
def tiny_avatar(tiny_checkpoint) -> Path:
    """avatar.onnx of ``tiny_checkpoint``."""
    from rnd_export.export import export
    from rnd_trainer.model.checkpoint import load_checkpoint

    path = tiny_checkpoint.with_suffix(".onnx")
    export(load_checkpoint(tiny_checkpoint), path)
    return path
