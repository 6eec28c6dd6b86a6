"""Pose refinement: bones as in the runtime, bounds, and improvement by training."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, load_motion
from rnd_runtime.posing.forearm import skinning_bones
from rnd_trainer.training.pose_refinement import (
    FADE_SECONDS,
    ROTATION_BOUND,
    TRANSLATION_BOUND,
    PoseRefinement,
    joint_error_degrees,
)
from rnd_trainer.training.saving import resume_training, save_training
from rnd_trainer.training.training import Training
from support.tiny import body, motion

FLOAT32 = 2e-6  # metres and matrix entries near 1, a chain of ten products


@pytest.mark.parametrize("twist", [0, 100])
def test_uncorrected_bones_are_the_runtimes(twist: float) -> None:
    skeleton, moves = body().skeleton, motion(body())
    ends = [skeleton.names.index(f"left_{end}") for end in ("elbow", "wrist")]
    bone = np.diff(skeleton.rest_joints[ends], axis=0)[0]
    moves.rotations[3, ends[1]] = axis_angle_to_matrix(np.radians(twist) * bone / np.linalg.norm(bone))
    refinement = PoseRefinement(moves, skeleton, [0, 3])
    expected = skinning_bones(skeleton, moves.rotations[3], moves.translations[3])
    assert np.abs(refinement.bones(3).detach().numpy() - expected).max() < FLOAT32


def test_the_corrected_motion_has_the_corrected_bones_and_stays_within_bounds() -> None:
    skeleton, moves = body().skeleton, motion(body())
    refinement = PoseRefinement(moves, skeleton, [1, 1, 4])
    assert refinement.frames == [1, 4]
    with torch.no_grad():
        for raw in refinement.raw:
            raw.copy_(torch.randn(raw.shape, generator=torch.Generator().manual_seed(0)))
    rotation, shift = refinement.bounded(4)
    assert rotation.abs().max() <= ROTATION_BOUND and shift.abs().max() <= TRANSLATION_BOUND
    corrected = refinement.apply_to(moves)
    expected = skinning_bones(skeleton, corrected.rotations[4], corrected.translations[4])
    assert np.abs(refinement.bones(4).detach().numpy() - expected).max() < FLOAT32


def test_between_training_frames_and_beyond_them_corrections_are_as_smooth_as_the_motion() -> None:
    skeleton, moves = body().skeleton, motion(body())
    refinement = PoseRefinement(moves, skeleton, [1, 4])
    with torch.no_grad():
        for raw, rotation in zip(refinement.raw, (0.03, 0.06)):
            raw[:, 0] = rotation
    corrected = refinement.apply_to(moves)
    first, last = (float(refinement.bounded(frame)[0][0, 0].detach()) for frame in (1, 4))
    fade = 1 / (moves.fps * FADE_SECONDS)
    expected = np.array([first * (1 - fade), first, (2 * first + last) / 3, (first + 2 * last) / 3, last])
    relative = np.swapaxes(moves.rotations, -1, -2) @ corrected.rotations
    angles = np.arccos((np.trace(relative, axis1=-2, axis2=-1) - 1) / 2)
    np.testing.assert_allclose(angles[:5], expected[:, None].repeat(angles.shape[1], 1), atol=1e-6)
    shifts = (corrected.translations - moves.translations)[:, 0]
    assert shifts[4] == np.abs(shifts).max() and 0 < shifts[2] < shifts[3] < shifts[4]


def test_refinement_does_not_make_noisy_poses_worse(tiny_capture, tiny_config) -> None:
    truth = tiny_capture.motion
    rng = np.random.default_rng(0)
    noise = np.radians(2) * rng.standard_normal((truth.frame_count, len(truth.joint_names), 3))
    bad = Motion(truth.rotations @ axis_angle_to_matrix(noise), truth.translations, truth.fps, truth.joint_names)
    config = dataclasses.replace(tiny_config, steps=150, refine_poses=True, light="none", refine_after=0.2)
    training = Training(dataclasses.replace(tiny_capture, motion=bad), config)
    for _ in range(config.steps):
        training.step()
    frames = range(truth.frame_count)
    before = joint_error_degrees(bad, truth, frames)
    after = joint_error_degrees(training.motion(), truth, frames)
    assert after < before, (after, before)


def test_a_refined_training_leaves_its_motion_and_resumes(tiny_capture, tiny_config, tmp_path) -> None:
    config = dataclasses.replace(tiny_config, refine_poses=True)
    torch.set_num_threads(1)
    training = Training(tiny_capture, config)
    for _ in range(8):
        training.step()
    save_training(training, tmp_path)
    written = load_motion(tmp_path / "refined_motion.npz", tiny_capture.body.skeleton)
    assert np.abs(written.rotations - training.motion().rotations).max() < 1e-6
    resumed = Training(tiny_capture, config)
    resume_training(resumed, tmp_path / "training.state")
    assert resumed.step().terms == training.step().terms
