"""The window's timing, and what it must not depend on."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix, rotation_6d
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.window import moment, motion_window

POSES, SECONDS = 10, 0.5
FLOAT32 = 1e-6  # results are float32 of numbers up to 1

# Slerp between samples 1/24 s apart misses the curve by at most |acceleration| / (8 · 24²) rad. The motion
# below accelerates by at most 0.25 · (2π · 0.5)² = 2.5 rad/s², so by 5.4e-4 rad.
RESAMPLING = 1e-3


def _smooth_motion(fps: float, seconds: float = 3.0) -> Motion:
    """Every joint swings about its own axis, at 0.5 Hz at most and by 0.25 rad, around its own offset."""
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(24, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rate, phase, offset = rng.uniform(0.2, 0.5, 24), rng.uniform(0, 6, 24), rng.uniform(-2, 2, 24)
    times = np.arange(round(seconds * fps) + 1)[:, None] / fps
    angles = offset + 0.25 * np.sin(2 * np.pi * rate * times + phase)
    rotations = axis_angle_to_matrix(axes * angles[..., None])
    return Motion(rotations, np.zeros((len(times), 3)), fps, SMPL_NAMES)


def _spin(rate: float, fps: float = 60.0, start: float = 0.0) -> Motion:
    """Joint 1 turns about Z at ``rate`` rad/s from angle ``start``; nothing else moves."""
    frames = 121
    axis_angles = np.zeros((frames, 3, 3))
    axis_angles[:, 1, 2] = start + rate * np.arange(frames) / fps
    return Motion(axis_angle_to_matrix(axis_angles), np.zeros((frames, 3)), fps, ("root", "a", "b"))


def test_window_is_evenly_spaced_and_ends_now():
    rate = 0.8
    window, velocity = motion_window(_spin(rate), 1.5, poses=5, seconds=0.4)
    assert window.shape == (5, 2, 6) and velocity.shape == (2, 3)
    assert window.dtype == velocity.dtype == np.float32
    angles = rate * np.array([1.1, 1.2, 1.3, 1.4, 1.5])
    expected = rotation_6d(axis_angle_to_matrix(np.outer(angles, [0, 0, 1])))
    assert_allclose(window[:, 0], expected, atol=FLOAT32)
    assert_allclose(window[:, 1], np.tile([1, 0, 0, 0, 1, 0], (5, 1)), atol=0)
    assert_allclose(velocity, [[0, 0, rate], [0, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("fps", [24, 25, 29.97, 50, 60, 120])
@pytest.mark.parametrize("time_s", [0.0, 0.2, 1.0, 2.37])
def test_window_is_independent_of_the_frame_rate(fps, time_s):
    # held in seconds: a window in frames would be five times as long at 24 as at 120
    window, velocity = motion_window(_smooth_motion(fps), time_s, poses=POSES, seconds=SECONDS)
    truth, true_velocity = motion_window(_smooth_motion(1000), time_s, poses=POSES, seconds=SECONDS)
    assert_allclose(window, truth, atol=RESAMPLING)
    spacing = SECONDS / (POSES - 1)
    assert_allclose(velocity, true_velocity, atol=2 * RESAMPLING / spacing)


def test_window_in_frames_would_fail_the_test_above():
    window, _ = motion_window(_smooth_motion(24), 1.0, poses=POSES, seconds=(POSES - 1) / 24)
    truth, _ = motion_window(_smooth_motion(120), 1.0, poses=POSES, seconds=(POSES - 1) / 120)
    assert np.abs(window - truth).max() > 50 * RESAMPLING


def test_turning_and_moving_the_root_changes_nothing_to_the_bit():
    motion = _smooth_motion(30)
    turned = motion.rotations.copy()
    turned[:, 0] = axis_angle_to_matrix([0.3, 2.0, -1.0]) @ turned[:, 0]
    moved = Motion(turned, motion.translations + np.array([5.0, 0.0, 2.0]), 30, motion.joint_names)
    for ours, theirs in zip(
        motion_window(motion, 1.234, poses=POSES, seconds=SECONDS),
        motion_window(moved, 1.234, poses=POSES, seconds=SECONDS),
    ):
        assert (ours == theirs).all()


def test_joint_turning_through_pi_is_continuous():
    """Its axis-angle jumps from +π to −π; the window and the velocity do not."""
    rate = 2.0
    motion = _spin(rate, start=np.pi - rate * 1.0)  # at π after one second
    times = 1.0 + np.linspace(-0.05, 0.05, 101)
    windows, velocities = zip(*(motion_window(motion, t, poses=4, seconds=0.3) for t in times))
    assert np.abs(np.diff(windows, axis=0)).max() < 1.01 * rate * 0.001
    assert_allclose(np.array(velocities)[:, 0], np.tile([0, 0, rate], (101, 1)), atol=1e-5)


def test_whole_turns_added_to_a_joint_change_nothing():
    a = motion_window(_spin(0.5), 1.0, poses=4, seconds=0.3)
    b = motion_window(_spin(0.5, start=2 * np.pi), 1.0, poses=4, seconds=0.3)
    for ours, theirs in zip(a, b):
        assert_allclose(ours, theirs, atol=FLOAT32)


def test_first_pose_is_held_before_the_motion_and_the_last_after_it():
    motion = _spin(1.0)
    window, velocity = motion_window(motion, 0.0, poses=4, seconds=0.3)
    assert (window == window[0]).all() and (velocity == 0).all()
    window, velocity = motion_window(motion, 99.0, poses=4, seconds=0.3)
    assert (window == window[0]).all() and (velocity == 0).all()


def test_window_of_one_pose_and_of_a_still():
    window, velocity = motion_window(_spin(0.7), 1.0, poses=1, seconds=0.25)
    assert window.shape == (1, 2, 6)
    assert_allclose(velocity[0], [0, 0, 0.7], atol=FLOAT32)  # over `seconds`, there being no spacing
    still = Motion(np.tile(np.eye(3), (1, 3, 1, 1)), np.zeros((1, 3)), 30.0, ("root", "a", "b"))
    window, velocity = motion_window(still, 0.0, poses=3, seconds=0.2)
    assert window.shape == (3, 2, 6) and (velocity == 0).all()


def _in_world(bones, root):
    """[J, 3, 4] of the root's frame, taken to the world."""
    return root[:3, :3] @ bones + np.pad(root[:3, 3:], ((0, 0), (3, 0)))


@pytest.mark.parametrize("time_s", [-1.0, 0.4, 1.23, 9.0])
@pytest.mark.parametrize("twist", [0.0, 1.9])  # of a wrist, which its forearm shares beyond 60°
@pytest.mark.parametrize("closed", [False, True])
def test_a_moment_has_the_bones_and_the_window_of_its_pose(time_s, twist, closed):
    rng = np.random.default_rng(1)
    smooth, places = _smooth_motion(24), rng.normal(size=(24, 3))
    rotations = smooth.rotations.copy()
    wrist, elbow = (SMPL_NAMES.index(name) for name in ("left_wrist", "left_elbow"))
    axis = (places[wrist] - places[elbow]) / np.linalg.norm(places[wrist] - places[elbow])
    rotations[:, wrist] = axis_angle_to_matrix(twist * axis)
    rotations[:, elbow] = np.eye(3)
    moved = np.cumsum(rng.normal(0, 0.01, (len(rotations), 3)), 0)
    motion, skeleton = Motion(rotations, moved, 24.0, SMPL_NAMES, closed=closed), smpl_skeleton(places)
    got = moment(motion, time_s, skeleton, poses=POSES, seconds=SECONDS)
    now = motion.at(time_s)
    expected = skinning_bones(skeleton, now.rotations[0], now.translations[0])
    assert_allclose(_in_world(got.bones, got.root), expected, atol=5 * FLOAT32)
    assert (np.abs(expected[elbow] - expected[SMPL_NAMES.index("left_shoulder")]).max() > 0.1) == (twist > 0)
    assert_allclose(got.bones[0], np.eye(4)[:3], atol=FLOAT32)
    assert_allclose(got.root[3], [0, 0, 0, 1], atol=0)
    for ours, alone in zip(got[:2], motion_window(motion, time_s, poses=POSES, seconds=SECONDS)):
        np.testing.assert_array_equal(ours, alone)


@pytest.mark.parametrize("joints", [23, 25])
def test_a_motion_of_other_joints_is_refused(joints):
    motion = Motion(np.tile(np.eye(3), (2, joints, 1, 1)), np.zeros((2, 3)), 24.0, ("joint",) * joints)
    with pytest.raises(InputError, match=f"joints of the motion: expected 24, got {joints}"):
        moment(motion, 0.0, smpl_skeleton(np.zeros((24, 3))), poses=POSES, seconds=SECONDS)


def test_a_skeleton_without_arms_has_moments_too():
    skeleton = Skeleton(("root", "a", "b"), np.array([-1, 0, 1]), np.zeros((3, 3)))
    got = moment(_spin(0.8), 1.0, skeleton, poses=3, seconds=0.2)
    assert_allclose(got.bones[1, :, :3], axis_angle_to_matrix([0, 0, 0.8]), atol=FLOAT32)
