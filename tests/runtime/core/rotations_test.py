"""Rotations against scipy, at the angles where textbook formulas break, and along paths."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quaternion,
    quaternion_to_matrix,
    slerp_matrices,
)

ROUND_OFF = 4e-15  # a few dozen float64 operations on numbers near 1
ANGLES = (0.0, 1e-300, 1e-160, 1e-12, 1e-9, 1e-8, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-8, np.pi)


def _axes(count: int = 40) -> np.ndarray:
    """Unit axes: random ones and the three coordinate axes, both ways."""
    random = np.random.default_rng(0).normal(size=(count, 3))
    axes = np.concatenate([random, np.eye(3), -np.eye(3)])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def test_axis_angle_agrees_with_scipy():
    vectors = np.random.default_rng(1).normal(size=(500, 3)) * 3
    assert_allclose(axis_angle_to_matrix(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=ROUND_OFF)


@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_round_trip_keeps_angle_and_axis(angle):
    axes = _axes()
    back = matrix_to_axis_angle(axis_angle_to_matrix(axes * angle))
    if angle == np.pi:  # both axes are right
        back *= np.sign((back * axes).sum(-1, keepdims=True))
    # 1e-12 of absolute accuracy right up to π; acos of the trace would give 1e-8 here
    assert_allclose(back, axes * angle, rtol=1e-12, atol=1e-15)


def test_trace_formula_is_what_we_avoid():
    """The textbook logarithm loses half the digits near π: the reason for going through quaternions."""
    angle = np.pi - 1e-8
    matrix = axis_angle_to_matrix([angle, 0, 0])
    textbook = np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))
    assert abs(textbook - angle) > 1e-9
    assert_allclose(np.linalg.norm(matrix_to_axis_angle(matrix)), angle, rtol=1e-15)


def test_matrices_near_zero_are_orthonormal():
    matrix = axis_angle_to_matrix(_axes() * 1e-7)
    assert_allclose(matrix @ matrix.swapaxes(-1, -2), np.broadcast_to(np.eye(3), matrix.shape), atol=ROUND_OFF)


def test_angles_are_periodic():
    axes = _axes()
    for turns in (-15, -1, 1, 2, 15):
        turned = axis_angle_to_matrix(axes * (0.7 + 2 * np.pi * turns))
        # the angle itself is rounded at 1e-14 after 15 turns
        assert_allclose(turned, axis_angle_to_matrix(axes * 0.7), atol=1e-13)


def test_quaternions_are_wxyz_with_positive_w_and_agree_with_scipy():
    assert_allclose(matrix_to_quaternion(axis_angle_to_matrix([0, np.pi / 2, 0])), [np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    vectors = np.concatenate([_axes() * angle for angle in ANGLES])
    quaternions = matrix_to_quaternion(axis_angle_to_matrix(vectors))
    theirs = Rotation.from_rotvec(vectors).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    assert (quaternions[:, 0] >= 0).all()
    assert_allclose(np.abs((quaternions * theirs).sum(1)), 1, atol=ROUND_OFF)
    assert_allclose(quaternion_to_matrix(quaternions), axis_angle_to_matrix(vectors), atol=ROUND_OFF)


def test_quaternion_of_any_length_and_sign_is_one_rotation():
    q = np.array([0.1, -0.7, 0.3, 0.2])
    assert_allclose(quaternion_to_matrix(-5 * q), quaternion_to_matrix(q), atol=ROUND_OFF)


def test_slerp_hits_its_ends_and_turns_at_constant_speed():
    a, b = axis_angle_to_matrix([[0.3, -1.2, 2.0], [1.0, 0.5, -0.4]])
    assert_allclose(slerp_matrices(a, b, 0.0), a, atol=ROUND_OFF)
    assert_allclose(slerp_matrices(a, b, 1.0), b, atol=ROUND_OFF)
    path = slerp_matrices(a, b, np.linspace(0, 1, 9))
    steps = np.linalg.norm(matrix_to_axis_angle(path[:-1].swapaxes(-1, -2) @ path[1:]), axis=-1)
    assert_allclose(steps, np.linalg.norm(matrix_to_axis_angle(a.T @ b)) / 8, rtol=1e-12)


def test_slerp_agrees_with_scipy():
    from scipy.spatial.transform import Slerp

    ends = Rotation.random(2, random_state=3)
    times = np.linspace(0, 1, 7)
    a, b = ends.as_matrix()
    assert_allclose(slerp_matrices(a, b, times), Slerp([0, 1], ends)(times).as_matrix(), atol=1e-14)


def test_slerp_between_equal_rotations_that_files_write_differently():
    """θ and θ + 2π, and axis-angles on both sides of π, are neighbours: no detour, no flip."""
    a = axis_angle_to_matrix([0, 0, np.pi - 0.01])
    b = axis_angle_to_matrix([0, 0, -np.pi + 0.01])
    middle = slerp_matrices(a, b, 0.5)
    assert_allclose(middle, axis_angle_to_matrix([0, 0, np.pi]), atol=1e-14)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-100, 100), min_size=3, max_size=3))
def test_every_axis_angle_gives_a_rotation_and_comes_back(vector):
    matrix = axis_angle_to_matrix(vector)
    assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(matrix) > 0
    assert_allclose(axis_angle_to_matrix(matrix_to_axis_angle(matrix)), matrix, atol=1e-13)
