"""Selection of frames by pose, and by sharpness within a pose."""

import cv2
import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_trainer.importing.select import select_frames, sharpness


def _turning(frames: int) -> Motion:
    """One rotation about the vertical in ``frames`` frames, each held for four."""
    angles = np.zeros((frames, 24, 3))
    angles[:, 0, 1] = 2 * np.pi * (np.arange(frames) // 4 * 4) / frames
    walk = np.linspace(0, 3, frames)[:, None] * np.array([1.0, 0, 0])
    return Motion(axis_angle_to_matrix(angles), walk, 30.0, SMPL_NAMES)


SKELETON = smpl_skeleton(np.random.default_rng(1).normal(size=(24, 3)))


def test_one_frame_of_every_pose_and_the_sharpest():
    rng = np.random.default_rng(0)
    sharp = rng.random(80)
    chosen = select_frames(_turning(80), SKELETON, sharp, 20)
    assert (chosen // 4 == np.arange(20)).all()
    assert (sharp[chosen] == sharp.reshape(20, 4).max(1)).all()


def test_fewer_frames_cover_the_rotation():
    chosen = select_frames(_turning(80), SKELETON, np.ones(80), 5)
    gaps = np.diff([*chosen, chosen[0] + 80])
    assert len(chosen) == 5 and gaps.max() <= 24  # farthest-point bins are within a factor 2 of the best, 16


def test_a_held_pose_is_not_taken_twice():
    motion = _turning(80)
    still = Motion(motion.rotations[[0] * 60 + list(range(0, 80, 4))], np.zeros((80, 3)), 30.0, SMPL_NAMES)
    chosen = select_frames(still, SKELETON, np.ones(80), 21)
    assert (chosen < 61).sum() == 1 and len(chosen) == 20


def test_unusable_frames_are_never_taken():
    sharp = np.where(np.arange(80) % 4 == 1, 0.1, -np.inf)
    assert (select_frames(_turning(80), SKELETON, sharp, 10) % 4 == 1).all()
    assert (select_frames(_turning(80), SKELETON, sharp, 500) == np.flatnonzero(sharp == 0.1)).all()


def test_invalid_arguments_are_refused():
    for sharpnesses, count in ((np.ones(3), 1), (np.ones(80), 0)):
        with pytest.raises(InputError):
            select_frames(_turning(80), SKELETON, sharpnesses, count)


def test_blur_lowers_sharpness_and_brightness_does_not():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (96, 96, 3), np.uint8), (0, 0), 1.0)
    blurred = [cv2.GaussianBlur(image, (0, 0), sigma) for sigma in (0.7, 1.0, 1.5)]
    values = [sharpness(one) for one in (image, *blurred)]
    assert (np.diff(values) < 0).all() and values[0] > 1.5 * values[1]
    darker = (image // 2).astype(np.uint8)
    assert abs(sharpness(darker) / sharpness(image) - 1) < 0.1  # rounding to half as many levels
    mask = np.zeros((96, 96), np.uint8)
    assert sharpness(image, mask) == 0
    mask[20:70, 20:70] = 255
    half_sharp = blurred[2].copy()
    half_sharp[15:75, 15:75] = image[15:75, 15:75]
    np.testing.assert_allclose(sharpness(half_sharp, mask), sharpness(image, mask), rtol=1e-6)
