"""Planted feet: a known slide, and what a correction may and may not move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.edit import looped
from rnd_runtime.motion.motion import Motion, load_motion
from rnd_runtime.motion.planting import feet_slide, plant_feet
from rnd_runtime.motion.skeleton import Skeleton
from support.paths import ASSETS

SKELETON = Body.load(ASSETS / "body.npz").skeleton
LEGS = [SKELETON.names.index(f"{side}_{part}") for side in ("left", "right") for part in ("knee", "ankle", "foot")]
FEET = [SKELETON.names.index(f"{side}_foot") for side in ("left", "right")]
MAX_STEP = 0.03  # m from frame to frame, of 1/30 s


def joints(motion: Motion) -> np.ndarray:
    return SKELETON.joint_transforms(motion.rotations, motion.translations)


def sway(speed: float, frames: int = 60) -> Motion:
    """Standing with bent knees, pushed to and fro at up to ``speed`` m/s."""
    rotations = np.tile(np.eye(3), (frames, len(SKELETON), 1, 1))
    for name, angle in {"hip": -0.3, "knee": 0.6, "ankle": -0.3}.items():
        turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
        for side in ("left", "right"):
            rotations[:, SKELETON.names.index(f"{side}_{name}")] = turn
    phase = 2 * np.pi * np.arange(frames) / 30
    translations = np.zeros((frames, 3))
    translations[:, 0] = speed / (2 * np.pi) * np.sin(phase)
    return Motion(rotations, translations, 30.0, SKELETON.names)


@pytest.fixture(scope="module")
def walk() -> Motion:
    """The walk on the spot, moved ahead by its mean step, so that each stance slides a little."""
    motion = load_motion(ASSETS / "walk.npz", SKELETON)
    feet = joints(motion)[:, :, :3, 3][:, FEET]
    lower = np.argmin(feet[..., 1], axis=1)
    step = np.diff(feet, axis=0)[np.arange(len(feet) - 1), lower[1:]].mean(axis=0) * [1, 0, 1]
    return replace(motion, translations=motion.translations - np.arange(len(feet))[:, None] * step)


def test_the_slide_is_the_speed_of_feet_that_stand():
    motion = sway(0.2)
    path = np.abs(np.diff(motion.translations[:, 0])).mean() * 30
    assert feet_slide(motion, SKELETON) == pytest.approx(path, rel=1e-6)
    assert feet_slide(sway(0.0), SKELETON) == 0
    lifted = replace(motion, translations=motion.translations + np.array([0, 1, 0]))
    assert feet_slide(lifted, SKELETON) == pytest.approx(path, rel=1e-6)  # its level is its own


def test_feet_of_a_swaying_body_stand_still():
    motion = sway(0.2)
    planted = plant_feet(motion, SKELETON)
    before, after = joints(motion), joints(planted)
    feet = after[..., :3, 3][:, FEET]
    np.testing.assert_allclose(feet, np.broadcast_to(feet[:1], feet.shape), atol=1e-4)
    np.testing.assert_allclose(after[:, FEET][..., :3, :3], before[:, FEET][..., :3, :3], atol=1e-6)
    assert feet_slide(planted, SKELETON) < 0.02 * feet_slide(motion, SKELETON)


def test_a_walk_slides_less_and_keeps_all_but_its_legs(walk):
    planted = plant_feet(walk, SKELETON)
    assert feet_slide(planted, SKELETON) < 0.5 * feet_slide(walk, SKELETON)
    moved = (joints(planted) - joints(walk))[..., :3, 3]
    assert np.abs(np.delete(moved, LEGS, axis=1)).max() < 1e-9
    assert np.abs(moved[:, FEET, 1]).max() < 2e-3  # heights stay
    assert np.linalg.norm(moved, axis=-1).max() < 0.09
    assert np.linalg.norm(np.diff(moved, axis=0), axis=-1).max() < MAX_STEP
    rotations = np.linalg.norm(np.diff(planted.rotations, axis=0), axis=(-2, -1)).max()
    assert rotations < 1.3 * np.linalg.norm(np.diff(walk.rotations, axis=0), axis=(-2, -1)).max()


def test_a_loop_has_no_seam(walk):
    closed = looped(replace(walk, translations=0.2 * walk.translations))
    moved = (joints(plant_feet(closed, SKELETON)) - joints(closed))[..., :3, 3]
    steps = np.linalg.norm(np.diff(moved, axis=0, append=moved[:1]), axis=-1).max(axis=1)
    assert steps[-1] < MAX_STEP


def test_a_body_that_stands_stays_to_the_bit():
    motion = sway(0.0)
    np.testing.assert_array_equal(plant_feet(motion, SKELETON).rotations, motion.rotations)


def test_without_legs_there_is_nothing_to_plant():
    pole = Skeleton(("root", "tip"), np.array([-1, 0]), np.array([[0, 0, 0], [0, 1, 0.0]]))
    motion = Motion(np.tile(np.eye(3), (3, 2, 1, 1)), np.zeros((3, 3)), 30.0, pole.names)
    assert feet_slide(motion, pole) is None
    with pytest.raises(InputError, match="--plant-feet"):
        plant_feet(motion, pole)
