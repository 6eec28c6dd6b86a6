"""Rows P17 and R9–R11: trainings of seconds on the studio's capture."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import torch

from rnd_bench.scenes.figures import Result, at_most, holds, stated
from rnd_bench.scenes.studio import write_studio
from rnd_bench.scenes.subject import Subject
from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.config import ModelConfig, TrainConfig
from rnd_trainer.training.run import run
from rnd_trainer.training.training import MAX_BAD_STEPS, Training

NOISE_DEGREES = 2.0
SHORT = 12
"""steps with a picture of a training that is only compared with another; more without one follow"""


def tiny_config(*, steps: int, gaussians: int = 1200) -> TrainConfig:
    """A training of seconds with all that a long one has."""
    model = ModelConfig(gaussians=gaussians, nodes=gaussians // 4, width=32, attribute_width=32, window_poses=5)
    return dataclasses.replace(
        TrainConfig(), model=model, steps=steps, stage1_fraction=0.4, light_texels=64, visibility_directions=6
    )


def nothing(*_: object) -> None:
    """For callbacks."""


@cache
def studio(subject: Subject) -> Capture:
    """The capture that trainings of this module see; the subject's own body."""
    return write_studio(subject.work / "studio", subject.body, size=subject.few(48, 96), frames=6)


def _short(subject: Subject) -> TrainConfig:
    return tiny_config(steps=SHORT, gaussians=subject.few(400, 4000))


def noisy_training_poses(subject: Subject) -> Result:
    """P17: train on poses with 2° of noise on every joint, refining them."""
    rng = np.random.default_rng(4)
    clean = studio(subject)
    noise = np.radians(NOISE_DEGREES) / np.sqrt(3) * rng.normal(size=(*clean.motion.rotations.shape[:2], 3))
    noise[:, 0] = 0  # a root that is off can hide behind the camera's own freedom
    rotations = clean.motion.rotations @ axis_angle_to_matrix(noise)
    motion = Motion(rotations, clean.motion.translations, clean.motion.fps, clean.motion.joint_names)
    config = tiny_config(steps=subject.few(60, 800), gaussians=subject.few(600, 4000))
    training = Training(dataclasses.replace(clean, motion=motion), dataclasses.replace(config, refine_poses=True))
    frames = sorted({view.frame.frame for view in training.views})
    before = _joint_error(motion, clean, frames)
    while training.step_index < config.steps:
        training.step()
    after = _joint_error(training.motion(), clean, frames)
    return Result(
        (
            at_most("joint error after training over before", after / before, 1.0, "×"),
            stated("joint error before", before, "mm"),
        )
    )


def _joint_error(motion: Motion, clean: Capture, frames: list[int]) -> float:
    """Mean distance in mm of the posed joints to the true ones."""
    skeleton = clean.body.skeleton

    def joints(given: Motion) -> np.ndarray:
        return skeleton.joint_transforms(given.rotations[frames], given.translations[frames])[..., :3, 3]

    return 1e3 * float(np.linalg.norm(joints(motion) - joints(clean.motion), axis=-1).mean())


def seeds(subject: Subject) -> Result:
    """R9: one seed twice at one thread; the spread of three."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        twice = [_trained(subject, 0) for _ in range(2)]
        different = [twice[0], _trained(subject, 1), _trained(subject, 2)]
    finally:
        torch.set_num_threads(before)
    pairs = zip(twice[0].model.state_dict().values(), twice[1].model.state_dict().values())
    unequal = sum(not torch.equal(a, b) for a, b in pairs)
    losses = [float(np.mean(training.last)) for training in different]
    return Result(
        (
            at_most("tensors that differ between two runs of one seed", unequal, 0),
            stated("image loss of three seeds: mean", float(np.mean(losses))),
            stated("image loss of three seeds: standard deviation", float(np.std(losses, ddof=1))),
        )
    )


class _Remembered(Training):
    """A training that keeps its last image losses."""

    last: list[float]


def _trained(subject: Subject, seed: int) -> _Remembered:
    training = _Remembered(studio(subject), dataclasses.replace(_short(subject), seed=seed))
    training.last = [terms["image"] for terms in _to_the_end(training) if "image" in terms][-4:]
    return training


def _to_the_end(training: Training) -> list[dict[str, float]]:
    """The loss terms of the steps that are left, of all stages."""
    return [training.step().terms for _ in range(training.schedule.total - training.step_index)]


def not_finite(subject: Subject) -> Result:
    """R10: a NaN in the weights: its steps are skipped and said so; ten in a row stop."""
    training, wrong = Training(studio(subject), _short(subject)), []
    training.step()
    kept = training.model.geometry_residual.detach().clone()
    with torch.no_grad():
        training.model.appearance_residual[0, 0] = float("nan")
    if not training.step().skipped or not torch.equal(training.model.geometry_residual, kept):
        wrong.append("the step was taken")
    taken = 1
    try:
        while taken < 3 * MAX_BAD_STEPS:
            training.step()
            taken += 1
        wrong.append("it went on")
    except InputError as error:
        if taken != MAX_BAD_STEPS - 1 or "not finite" not in str(error):
            wrong.append(f"it stopped after {taken}: {error}")
    return Result((holds("ways in which a NaN is not met", wrong),))


def resumed(subject: Subject) -> Result:
    """R11: stop at half and go on."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        whole = Training(studio(subject), _short(subject))
        curve = _to_the_end(whole)
        half = Training(studio(subject), _short(subject))
        for _ in range(SHORT // 2):
            half.step()
        folder = subject.work / "resumed"
        half.save(folder)
        again = Training(studio(subject), _short(subject))
        again.resume(folder / "training.state")
        rest = _to_the_end(again)
    finally:
        torch.set_num_threads(before)
    pairs = zip(rest, curve[SHORT // 2 :], strict=True)
    off = max(abs(ours[name] - theirs[name]) for ours, theirs in pairs for name in theirs)
    return Result((at_most("losses after resuming, largest difference to the unbroken run", off, 0),))


def train_small(folder: Path, capture: Capture, steps: int, gaussians: int) -> Path:
    """Train an avatar of seconds and return its checkpoint."""
    run(Training(capture, tiny_config(steps=steps, gaussians=gaussians)), folder, on_step=nothing, on_preview=nothing)
    return folder / "avatar.ckpt"
