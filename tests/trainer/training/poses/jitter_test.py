"""Jitter of estimated motions: noise of single frames goes, motion and slow errors stay."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.motion import Motion
from rnd_trainer.training.poses.jitter import without_jitter

FRAMES, JOINTS = 240, 3
UNSMOOTHED = 0.02
"""degrees that a clean motion may change: a cubic over five frames of half a hertz errs by less"""
LEFT = 0.65
"""of white noise: a cubic over 2·5 + 1 frames leaves 0.46, narrower ones beside fast motion more"""


def _swinging() -> Motion:
    """Joints that swing by half a radian, up to once in two seconds, over a root that walks."""
    seconds = np.arange(FRAMES)[:, None, None] / 30
    hertz = np.linspace(0.1, 0.5, JOINTS)[:, None]
    turns = 0.5 * np.sin(2 * np.pi * hertz * seconds + np.arange(3))
    walk = np.stack([0.8 * seconds[:, 0, 0], 0.02 * np.sin(3 * seconds[:, 0, 0]), 0 * seconds[:, 0, 0]], 1)
    return Motion(axis_angle_to_matrix(turns), walk, 30.0, ("pelvis", "spine", "head"))


def _disturbed(motion: Motion, degrees: float, correlated: float = 0.0) -> Motion:
    """``motion`` with noise on each axis, 5 mm a degree at the root, correlated over so many frames."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(FRAMES, JOINTS + 1, 3))
    if correlated:
        noise = gaussian_filter1d(noise, correlated, axis=0)
        noise /= noise.std()
    rotations = motion.rotations @ axis_angle_to_matrix(np.radians(degrees) * noise[:, :JOINTS])
    return dataclasses.replace(
        motion, rotations=rotations, translations=motion.translations + 0.005 * degrees * noise[:, -1]
    )


def _degrees(first: Motion, second: Motion) -> float:
    turns = matrix_to_axis_angle(np.swapaxes(first.rotations, -1, -2) @ second.rotations)
    return float(np.degrees(np.sqrt(np.mean(turns**2))))


@pytest.mark.parametrize("degrees", [0.5, 1.0, 3.0])
def test_noise_of_single_frames_goes(degrees: float) -> None:
    truth = _swinging()
    given = _disturbed(truth, degrees)
    found = without_jitter(given)
    assert _degrees(found, truth) < LEFT * _degrees(given, truth)
    before, after = (np.abs(motion.translations - truth.translations).mean() for motion in (given, found))
    assert after < LEFT * before


def test_a_clean_motion_stays() -> None:
    truth = _swinging()
    assert _degrees(without_jitter(truth), truth) < UNSMOOTHED


def test_errors_that_last_are_no_jitter() -> None:
    given = _disturbed(_swinging(), 2.0, correlated=4)
    assert _degrees(without_jitter(given), given) < UNSMOOTHED


def test_a_joint_at_rest_stays_beside_one_that_jitters() -> None:
    given = _disturbed(_swinging(), 1.0)
    given.rotations[:, 1] = np.eye(3)
    assert np.array_equal(without_jitter(given).rotations[:, 1], given.rotations[:, 1])


def test_the_ends_and_short_or_slow_motions_stay() -> None:
    given = _disturbed(_swinging(), 1.0)
    ends = [0, 1, -2, -1]
    assert np.allclose(without_jitter(given).rotations[ends], given.rotations[ends], rtol=0, atol=1e-12)
    short = dataclasses.replace(given, rotations=given.rotations[:20], translations=given.translations[:20])
    assert without_jitter(short) is short
    slow = dataclasses.replace(given, fps=15.0)
    assert without_jitter(slow) is slow
