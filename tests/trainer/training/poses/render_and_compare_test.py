"""Fits of a film's poses to its avatar during training."""

from __future__ import annotations

import dataclasses
import signal

import numpy as np
import pytest
import torch

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.training.poses.uncertainty import PoseUncertainty, save_uncertainty
from rnd_trainer.training.run import run
from rnd_trainer.training.saving import resume_training, save_training
from rnd_trainer.training.schedule import POSE_FITS
from rnd_trainer.training.training import POSE_FIT, Training


@pytest.fixture
def film(tiny_capture, tmp_path):
    """A copy of the tiny capture's description whose poses come with their uncertainty."""
    motion, joints = tiny_capture.motion, len(tiny_capture.body.skeleton)
    deviations = PoseUncertainty(np.full((motion.frame_count, joints, 3), 0.1), np.full((motion.frame_count, 3), 0.02))
    folder = tmp_path / "film"
    folder.mkdir()
    for file in tiny_capture.folder.iterdir():
        (folder / file.name).symlink_to(file)
    save_uncertainty(folder, deviations)
    return dataclasses.replace(tiny_capture, folder=folder)


def test_a_films_wrong_poses_come_nearer_by_its_fits_alone(film, tiny_config) -> None:
    truth, skeleton = film.motion, film.body.skeleton

    def off(motion: Motion) -> float:
        """Mean distance of the joints from the truth, m."""
        joints = [skeleton.joint_transforms(m.rotations, m.translations)[..., :3, 3] for m in (motion, truth)]
        return float(np.linalg.norm(joints[0] - joints[1], axis=-1).mean())

    noise = np.radians(3) * np.random.default_rng(0).standard_normal((truth.frame_count, len(skeleton), 3))
    bad = Motion(truth.rotations @ axis_angle_to_matrix(noise), truth.translations, truth.fps, truth.joint_names)
    config = dataclasses.replace(tiny_config, steps=150, refine_poses=True, light="none")
    training = Training(dataclasses.replace(film, motion=bad), config)
    for _ in range(config.steps):
        training.step()
    assert off(training.motion()) < 0.9 * off(bad), (off(training.motion()), off(bad))


def test_a_films_poses_are_fitted_between_steps_and_others_are_not(film, tiny_capture, tiny_config) -> None:
    config = dataclasses.replace(tiny_config, refine_poses=True, refine_after=1.0)  # others are corrected later
    for capture, fitted in ((film, True), (tiny_capture, False)):
        training, searched = Training(capture, config), []
        training.on_search = lambda name, done, total, names=searched: names.append(name)
        for _ in range(round(POSE_FITS[0] * config.steps)):
            training.step()
        assert training.refinement is not None and not any(raw.any() for raw in training.refinement.raw)
        training.step()
        assert all(raw[:-1].any() for raw in training.refinement.raw) == fitted
        assert not any(raw[-1].any() for raw in training.refinement.raw)
        assert (POSE_FIT in searched) == fitted
        assert all(p.requires_grad for p in training.model.parameters())


def test_a_training_resumed_before_a_fit_continues_on_the_same_curve(film, tiny_config, tmp_path) -> None:
    config = dataclasses.replace(tiny_config, refine_poses=True)
    torch.set_num_threads(1)
    training = Training(film, config)
    for _ in range(round(POSE_FITS[0] * config.steps)):
        training.step()
    save_training(training, tmp_path)
    resumed = Training(film, config)
    resume_training(resumed, tmp_path / "training.state")
    assert resumed.step().terms == training.step().terms


def test_a_signal_during_a_fit_leaves_it_and_the_run_continues_on_the_same_curve(film, tiny_config, tmp_path) -> None:
    config = dataclasses.replace(tiny_config, refine_poses=True)
    torch.set_num_threads(1)
    at = round(POSE_FITS[0] * config.steps)

    def interrupt(name: str, done: float, total: float) -> None:
        if name == POSE_FIT and done == 1:
            signal.raise_signal(signal.SIGINT)

    training = Training(film, config)
    nothing = {"on_step": lambda step: None, "on_preview": lambda: None}
    assert run(training, tmp_path, on_phase=interrupt, **nothing)
    assert training.step_index == at
    assert training.refinement is not None and not any(raw.any() for raw in training.refinement.raw)
    resumed, straight = Training(film, config), Training(film, config)
    resume_training(resumed, tmp_path / "training.state")
    for _ in range(at):
        straight.step()
    assert resumed.step().terms == straight.step().terms
