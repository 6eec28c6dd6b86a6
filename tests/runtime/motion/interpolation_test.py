"""Poses between frames: against smooth motions, scipy's steps and what must hold at the frames."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp_matrices
from rnd_runtime.motion.interpolation import (
    LARGEST_MOVE,
    LARGEST_STEP,
    interpolate_points,
    interpolate_rotations,
    step_between,
)

ROUND_OFF = 1e-12  # float64, some hundred operations
AXES = np.array([[1.0, 0.3, -0.2], [0.1, -1.2, 0.4], [0.6, 0.2, 0.9]])


def _angles(time: np.ndarray) -> np.ndarray:
    """Three joints swinging as in a walk of one step a second, about axes that turn: [T, 3, 3] rad."""
    swing = 0.5 * np.sin(2 * np.pi * time[:, None] + [0.0, 1.0, 2.5])
    drift = 0.2 * np.cos(np.pi * time[:, None, None] + np.arange(3))
    return swing[:, :, None] * AXES + drift


def _rotations(time: np.ndarray) -> np.ndarray:
    return axis_angle_to_matrix(_angles(time))


def _off(got: np.ndarray, expected: np.ndarray) -> float:
    """The largest angle between two sets of rotations, rad."""
    return float(np.linalg.norm(matrix_to_axis_angle(np.swapaxes(got, -1, -2) @ expected), axis=-1).max())


def _errors(fps: float) -> tuple[float, float]:
    """Of the cubic and of slerp, at times between the frames of two seconds, the ends left out."""
    frames = _rotations(np.arange(int(2 * fps) + 1) / fps)
    place = np.linspace(2, 2 * fps - 2, 517)
    before = np.minimum(place.astype(int), len(frames) - 2)
    straight = slerp_matrices(frames[before], frames[before + 1], (place - before)[:, None])
    truth = _rotations(place / fps)
    return _off(interpolate_rotations(frames, place), truth), _off(straight, truth)


def test_steps_are_the_logarithms_of_scipy():
    before, after = _rotations(np.array([0.3]))[0], _rotations(np.array([0.9]))[0]
    truth = (Rotation.from_matrix(before).inv() * Rotation.from_matrix(after)).as_rotvec()
    step = np.empty(3)
    for a, b, expected in zip(before, after, truth):
        step_between(a, b, step)
        assert_allclose(step, expected, atol=ROUND_OFF)
        step_between(a, a, step)
        assert_allclose(step, np.zeros(3), atol=ROUND_OFF)


def test_a_walk_is_followed_in_third_order_where_slerp_has_second():
    cubic, straight = zip(*(_errors(fps) for fps in (25.0, 50.0)))
    assert 2.8 < np.log2(cubic[0] / cubic[1]) < 3.2
    assert 1.8 < np.log2(straight[0] / straight[1]) < 2.2
    assert cubic[0] < 2e-4 < 20 * cubic[0] < straight[0]  # rad


def test_points_are_followed_in_third_order():
    def error(fps: float) -> float:
        frames = _angles(np.arange(int(2 * fps) + 1) / fps)[:, 0]
        place = np.linspace(2, 2 * fps - 2, 517)
        return float(np.abs(interpolate_points(frames, place) - _angles(place / fps)[:, 0]).max())

    assert 2.8 < np.log2(error(25.0) / error(50.0)) < 3.2


def test_frames_come_back_to_the_bit():
    frames, points = _rotations(np.arange(9) / 30), np.random.default_rng(0).normal(size=(9, 3))
    place = np.arange(9.0)
    assert np.array_equal(interpolate_rotations(frames, place), frames)
    assert np.array_equal(interpolate_points(points, place), points)


def test_the_velocity_does_not_jump_at_a_frame():
    """Steps of a hundredth before and after a frame, near either end too, where slerp's differ by percents."""
    frames = _rotations(np.arange(7) / 10)
    for frame in (1, 3, 5):
        a, b, c = interpolate_rotations(frames, frame + np.array([-1e-3, 0.0, 1e-3]))
        before, after = (matrix_to_axis_angle(a.swapaxes(-1, -2) @ b), matrix_to_axis_angle(b.swapaxes(-1, -2) @ c))
        assert_allclose(before, after, atol=2e-3 * np.abs(before).max())


@pytest.mark.parametrize("frames", [2, 3, 4])
def test_a_steady_turn_stays_steady(frames):
    """Also where there is no frame before or after; the axis goes through π."""
    vectors = np.outer(np.pi - 0.3 + 0.4 * np.arange(frames), [0.6, 0.0, 0.8])
    place = np.linspace(0, frames - 1, 23)
    expected = axis_angle_to_matrix(np.outer(np.pi - 0.3 + 0.4 * place, [0.6, 0.0, 0.8]))
    got = interpolate_rotations(axis_angle_to_matrix(vectors)[:, None], place)[:, 0]
    assert_allclose(got, expected, atol=ROUND_OFF)
    points = np.arange(frames)[:, None] * np.array([1.0, -2.0, 0.5])
    assert_allclose(interpolate_points(points, place), place[:, None] * [1.0, -2.0, 0.5], atol=ROUND_OFF)


@pytest.mark.parametrize("where", [0, 1, 2])
def test_beside_a_cut_the_path_is_the_geodesic(where):
    """A turn larger than LARGEST_STEP before, in or after the interval."""
    turns = np.full(3, 0.2)
    turns[where] = 1.01 * LARGEST_STEP
    angles = np.array([0, *np.cumsum(turns)])[:, None] * np.array([0.0, 1.0, 0.0])
    frames = axis_angle_to_matrix(angles + np.array([0.3, 0.0, 0.0]))
    steps = Rotation.from_matrix(frames)
    assert (steps[where].inv() * steps[where + 1]).magnitude() > LARGEST_STEP
    got = interpolate_rotations(frames[:, None], np.array([1.37]))[0, 0]
    assert_allclose(got, slerp_matrices(frames[1], frames[2], 0.37), atol=ROUND_OFF)
    moves = np.where(np.arange(3) == where, 1.01 * LARGEST_MOVE, 0.2)
    points = np.array([0, *np.cumsum(moves)])[:, None] * np.array([0.6, 0.8, 0.0])
    got = interpolate_points(points, np.array([1.37]))[0]
    assert_allclose(got, 0.63 * points[1] + 0.37 * points[2], atol=ROUND_OFF)


def test_any_rotations_give_rotations():
    """Random frames, half turns and frames that are equal among them."""
    frames = Rotation.random(40, random_state=5).as_matrix()
    frames[10] = frames[11]
    frames[20] = frames[21] @ np.diag([1.0, -1.0, -1.0])
    got = interpolate_rotations(frames[:, None], np.linspace(0, 39, 1001))[:, 0]
    assert_allclose(got @ got.swapaxes(-1, -2), np.broadcast_to(np.eye(3), got.shape), atol=ROUND_OFF)
    assert_allclose(np.linalg.det(got), 1, atol=ROUND_OFF)
