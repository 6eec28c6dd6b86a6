"""Rows P17 and R9–R11: short trainings on the studio's capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, at_most, holds, reported, result
from rnd_bench.stability.small import studio, tiny_config
from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.training.saving import resume_training, save_training
from rnd_trainer.training.training import MAX_BAD_STEPS, Training

NOISE_DEGREES = 2.0
SHORT = 12  # steps with an image; steps without one follow


def noisy_training_poses(subject: Subject) -> Result:
    """P17: pose refinement of 2° noise on every joint."""
    rng = np.random.default_rng(4)
    clean = studio(subject)
    noise = np.radians(NOISE_DEGREES) / np.sqrt(3) * rng.normal(size=(*clean.motion.rotations.shape[:2], 3))
    noise[:, 0] = 0  # root and camera are ambiguous
    motion = dataclasses.replace(clean.motion, rotations=clean.motion.rotations @ axis_angle_to_matrix(noise))
    config = tiny_config(steps=subject.few(60, 800), gaussians=subject.few(600, 4000))
    training = Training(dataclasses.replace(clean, motion=motion), dataclasses.replace(config, refine_poses=True))
    frames = sorted({view.frame.frame for view in training.views})
    before = _joint_error(motion, clean, frames)
    while training.step_index < config.steps:
        training.step()
    after = _joint_error(training.motion(), clean, frames)
    return result(
        at_most("joint error after training over before", after / before, 1.0, "×"),
        reported("joint error before", before, "mm"),
    )


def _joint_error(motion: Motion, clean: Capture, frames: list[int]) -> float:
    """Mean distance of the posed joints to the true ones, mm."""

    def joints(given: Motion) -> np.ndarray:
        transforms = clean.body.skeleton.joint_transforms(given.rotations[frames], given.translations[frames])
        return transforms[..., :3, 3]

    return 1e3 * float(np.linalg.norm(joints(motion) - joints(clean.motion), axis=-1).mean())


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _training(subject: Subject, seed: int = 0) -> Training:
    config = tiny_config(steps=SHORT, gaussians=subject.few(400, 4000))
    return Training(studio(subject), dataclasses.replace(config, seed=seed))


def _to_the_end(training: Training) -> list[dict[str, float]]:
    """Loss terms of the remaining steps."""
    return [training.step().terms for _ in range(training.schedule.total - training.step_index)]


def seeds(subject: Subject) -> Result:
    """R9: two runs of one seed with one thread; the deviation of three seeds."""
    trainings = [_training(subject, seed) for seed in (0, 0, 1, 2)]
    with _one_thread():
        terms = [_to_the_end(training) for training in trainings]
    once, twice = (training.model.state_dict().values() for training in trainings[:2])
    unequal = sum(not torch.equal(a, b) for a, b in zip(once, twice))
    losses = [float(np.mean([step["image"] for step in steps if "image" in step][-4:])) for steps in terms[1:]]
    return result(
        at_most("tensors that differ between two runs of one seed", unequal, 0),
        reported("image loss of three seeds: mean", float(np.mean(losses))),
        reported("image loss of three seeds: standard deviation", float(np.std(losses, ddof=1))),
    )


def not_finite(subject: Subject) -> Result:
    """R10: steps with a NaN are skipped and reported; ten in a row stop the training."""
    training, wrong = _training(subject), []
    training.step()
    before = training.model.geometry_residual.detach().clone()
    with torch.no_grad():
        training.model.appearance_residual[0, 0] = float("nan")
    if not training.step().skipped or not torch.equal(training.model.geometry_residual, before):
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
    return result(holds("ways in which a NaN is not met", wrong))


def resumed(subject: Subject) -> Result:
    """R11: a run resumed at half, against an unbroken one."""
    with _one_thread():
        curve = _to_the_end(_training(subject))
        half = _training(subject)
        for _ in range(SHORT // 2):
            half.step()
        save_training(half, subject.work / "resumed")
        again = _training(subject)
        resume_training(again, subject.work / "resumed/training.state")
        rest = _to_the_end(again)
    pairs = zip(rest, curve[SHORT // 2 :], strict=True)
    off = max(abs(ours[name] - theirs[name]) for ours, theirs in pairs for name in theirs)
    return result(at_most("losses after resuming, largest difference to the unbroken run", off, 0))
