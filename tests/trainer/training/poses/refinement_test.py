"""Pose refinement: bones as in the runtime, bounds, and improvement by training."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, load_motion
from rnd_runtime.posing.forearm import skinning_bones
from rnd_trainer.training.poses.refinement import (
    DEVIATIONS,
    FADE_SECONDS,
    ROTATION_BOUND,
    ROTATION_LIMITS,
    TRANSLATION_BOUND,
    TRANSLATION_LIMITS,
    PoseRefinement,
)
from rnd_trainer.training.poses.uncertainty import PoseUncertainty, load_uncertainty, save_uncertainty
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


def test_corrections_go_as_far_as_the_estimate_is_unsure() -> None:
    skeleton, moves = body().skeleton, motion(body())
    deviations = PoseUncertainty(
        np.full((moves.frame_count, len(skeleton), 3), 0.01), np.full((moves.frame_count, 3), 0.001)
    )
    deviations.rotations[1, 2] = 0.1
    refinement = PoseRefinement(moves, skeleton, [1, 4], deviations)
    with torch.no_grad():
        for raw in refinement.raw:
            raw.fill_(10.0)
    rotation, shift = refinement.bounded(1)
    assert rotation[2].tolist() == pytest.approx([0.1 * DEVIATIONS] * 3)
    assert rotation[0].tolist() == pytest.approx([ROTATION_LIMITS[0]] * 3)
    assert shift.tolist() == pytest.approx([TRANSLATION_LIMITS[0]] * 3)


def test_neighbours_in_time_are_corrected_alike() -> None:
    skeleton, moves = body().skeleton, motion(body())
    slow = dataclasses.replace(moves, fps=2.0)
    near, apart = (PoseRefinement(m, skeleton, [1, 2, 3]) for m in (moves, slow))
    for refinement in (near, apart):
        with torch.no_grad():
            for raw in refinement.raw:
                raw.fill_(0.05)
        alike = float(refinement.prior(2).detach())
        with torch.no_grad():
            refinement.raw[0].fill_(-0.05)
        other = float(refinement.prior(2).detach())
        assert (other > 1.5 * alike) == (refinement is near), (alike, other)


def test_deviations_of_a_capture_are_read_and_checked(tmp_path) -> None:
    wanted = PoseUncertainty(np.full((3, 2, 3), 0.1), np.full((3, 3), 0.02))
    assert load_uncertainty(tmp_path, 3, 2) is None
    save_uncertainty(tmp_path, wanted)
    found = load_uncertainty(tmp_path, 3, 2)
    assert found is not None and np.allclose(found.rotations, 0.1) and np.allclose(found.translations, 0.02)
    with pytest.raises(InputError, match="rotation_deviation"):
        load_uncertainty(tmp_path, 4, 2)
    save_uncertainty(tmp_path, PoseUncertainty(-wanted.rotations, wanted.translations))
    with pytest.raises(InputError, match="negative"):
        load_uncertainty(tmp_path, 3, 2)


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


def test_refinement_brings_the_joints_of_noisy_poses_nearer(tiny_capture, tiny_config) -> None:
    truth, skeleton = tiny_capture.motion, tiny_capture.body.skeleton

    def off(motion: Motion) -> float:
        """Mean distance of the joints from the truth, m, which images show, unlike the angles of hands."""
        joints = [skeleton.joint_transforms(m.rotations, m.translations)[..., :3, 3] for m in (motion, truth)]
        return float(np.linalg.norm(joints[0] - joints[1], axis=-1).mean())

    rng = np.random.default_rng(0)
    noise = np.radians(2) * rng.standard_normal((truth.frame_count, len(truth.joint_names), 3))
    bad = Motion(truth.rotations @ axis_angle_to_matrix(noise), truth.translations, truth.fps, truth.joint_names)
    config = dataclasses.replace(tiny_config, steps=150, refine_poses=True, light="none", refine_after=0.2)
    training = Training(dataclasses.replace(tiny_capture, motion=bad), config)
    for _ in range(config.steps):
        training.step()
    assert off(training.motion()) < 0.9 * off(bad), (off(training.motion()), off(bad))


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
