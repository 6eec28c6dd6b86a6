"""Small captures and trainings of seconds."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

from rnd_bench.scenes.studio import write_studio
from rnd_bench.scenes.subject import Subject
from rnd_runtime.capture.capture import Capture
from rnd_trainer.config import ModelConfig, TrainConfig
from rnd_trainer.training.run import run
from rnd_trainer.training.training import Training


def tiny_config(*, steps: int, gaussians: int = 1200) -> TrainConfig:
    """A training of seconds with all parts of a long one."""
    model = ModelConfig(gaussians=gaussians, nodes=gaussians // 4, width=32, attribute_width=32, window_poses=5)
    config = dataclasses.replace(TrainConfig(), model=model, steps=steps, stage1_fraction=0.4)
    return dataclasses.replace(config, light_texels=64, visibility_directions=6)


@cache
def studio(subject: Subject) -> Capture:
    """A small capture of the subject's own body."""
    return write_studio(subject.work / "studio", subject.body, size=subject.few(48, 96), frames=6)


def train_small(folder: Path, capture: Capture, steps: int, gaussians: int) -> Path:
    """Train for seconds and return the checkpoint."""
    training = Training(capture, tiny_config(steps=steps, gaussians=gaussians))
    run(training, folder, on_step=lambda step: None, on_preview=lambda: None)
    return folder / "avatar.ckpt"
