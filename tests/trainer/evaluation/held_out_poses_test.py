"""Render-and-compare of held-out frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rnd_runtime.motion.motion import Motion
from rnd_trainer.evaluation.held_out_poses import fit_held_out
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.training.poses.refinement import joint_error_degrees


@pytest.mark.slow
def test_wrong_poses_of_held_out_frames_come_closer_and_others_stay(tiny_run, tiny_capture) -> None:
    checkpoint, truth = load_checkpoint(tiny_run / "avatar.ckpt"), tiny_capture.motion
    frames = sorted({frame.frame for frame in tiny_capture.split("novel_view")})
    wrong = truth.translations + np.array([0.03, 0.0, 0.0])
    bad = Motion(truth.rotations, wrong, truth.fps, truth.joint_names)
    before = [p.detach().clone() for p in checkpoint.model.parameters()]
    found = fit_held_out(
        checkpoint, dataclasses.replace(tiny_capture, motion=bad), ("novel_view",), steps=20, scale=1.0
    )
    error = np.abs(found.translations[frames] - truth.translations[frames])[:, 0].mean()
    assert error < 0.02, error
    assert joint_error_degrees(found, truth, frames) < 3
    assert all((a == b).all() for a, b in zip(before, checkpoint.model.parameters()))


def test_a_capture_without_such_frames_keeps_its_motion(tiny_run, tiny_capture) -> None:
    checkpoint = load_checkpoint(tiny_run / "avatar.ckpt")
    assert fit_held_out(checkpoint, tiny_capture, ("novel_pose",)) is tiny_capture.motion
