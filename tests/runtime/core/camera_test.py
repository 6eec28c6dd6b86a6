"""Cameras: looking, resizing, and what is not a camera."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError

K = np.array([[500.0, 0, 301.5], [0, 510.0, 222.25], [0, 0, 1]])
EXACT = 1e-12


def _project(camera: Camera, points: np.ndarray) -> np.ndarray:
    pixels = (camera.world_to_camera[:3, :3] @ points.T).T + camera.world_to_camera[:3, 3]
    pixels = pixels @ camera.K.T
    return pixels[:, :2] / pixels[:, 2:]


@pytest.mark.parametrize("eye", [[0, 1, 3], [2, 5, -1], [0, 4, 0], [0, -4, 0], [-3, 0, 0]])
def test_look_at_is_rigid_upright_and_centred(eye):
    target = np.array([0.0, 1, 0])
    camera = Camera.look_at(eye, target, width=640, height=480, fov_y=0.7)
    rotation = camera.world_to_camera[:3, :3]
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT)
    assert_allclose(np.linalg.det(rotation), 1, atol=EXACT)
    assert_allclose(camera.position, eye, atol=EXACT)
    assert_allclose(_project(camera, target[None])[0], [320, 240], atol=1e-9)
    if eye[0] or eye[2]:  # not straight down or up: world up is up in the picture
        assert _project(camera, np.array([[0.0, 1.1, 0]]))[0, 1] < 240
        assert abs(rotation[0, 1]) < EXACT  # and the horizon is level


def test_field_of_view_is_vertical():
    camera = Camera.look_at([0, 0, 2], [0, 0, 0], width=300, height=100, fov_y=np.radians(60))
    edge = 2 * np.tan(np.radians(30))
    assert_allclose(_project(camera, np.array([[0, edge, 0], [0, -edge, 0]])), [[150, 0], [150, 100]], atol=1e-9)


def test_look_at_along_its_up():
    for up in np.eye(3):
        camera = Camera.look_at(3 * up, [0, 0, 0], width=10, height=10, fov_y=1.0, up=tuple(up))
        assert np.allclose(camera.world_to_camera[2, :3], -up)


def test_look_at_with_another_up():
    camera = Camera.look_at([0, -3, 0], [0, 0, 0], width=10, height=10, fov_y=1.0, up=(0, 0, 1))
    assert _project(camera, np.array([[0.0, 0, 0.1]]))[0, 1] < 5


@pytest.mark.parametrize("size", [(320, 240), (641, 479), (1, 1), (4096, 2)])
def test_resizing_scales_pixel_positions_with_the_picture(size):
    camera = Camera(640, 480, K, np.eye(4))
    points = np.random.default_rng(0).normal((0, 0, 4), size=(50, 3))
    small = camera.resized(*size)
    assert (small.width, small.height) == size
    assert_allclose(_project(small, points), _project(camera, points) * np.array(size) / [640, 480], atol=1e-9)
    assert (small.world_to_camera == camera.world_to_camera).all()


def test_off_centre_principal_points_are_kept():
    assert_allclose(_project(Camera(640, 480, K, np.eye(4)), np.array([[0.0, 0, 1]]))[0], [301.5, 222.25])


def _with(matrix: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    matrix = np.array(matrix, float)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0, 480, K, np.eye(4)), "at least 1 x 1, got 0 x 480"),
        ((640, -1, K, np.eye(4)), "at least 1 x 1"),
        ((640, 480, K[:2], np.eye(4)), "camera K"),
        ((640, 480, _with(K, 0, 0, -500), np.eye(4)), "positive focal"),
        ((640, 480, _with(K, 1, 2, np.nan), np.eye(4)), "camera K"),
        ((640, 480, _with(K, 0, 1, 2.0), np.eye(4)), "fx 0 cx, 0 fy cy, 0 0 1"),
        ((640, 480, _with(K, 1, 0, 2.0), np.eye(4)), "fx 0 cx, 0 fy cy, 0 0 1"),
        ((640, 480, K.T, np.eye(4)), "fx 0 cx, 0 fy cy, 0 0 1"),
        ((640, 480, 2 * K, np.eye(4)), "fx 0 cx, 0 fy cy, 0 0 1"),
        ((640, 480, K, np.eye(4)[:3]), "4 x 4 rigid"),
        ((640, 480, K, np.diag([2.0, 2, 2, 1])), "4 x 4 rigid"),
        ((640, 480, K, np.diag([1.0, 1, -1, 1])), "4 x 4 rigid"),
        ((640, 480, K, _with(np.eye(4), 0, 3, np.inf)), "4 x 4 rigid"),
        ((640, 480, K, _with(np.eye(4), 0, 0, 1e300)), "4 x 4 rigid"),
        ((640, 480, K, _with(np.eye(4), 3, 2, 1.5)), "4 x 4 rigid"),
        ((640, 480, K, _with(np.eye(4), 3, 3, 2.0)), "4 x 4 rigid"),
    ],
)
def test_what_is_no_camera_is_refused(arguments, words):
    with pytest.raises(InputError) as caught:
        Camera(*arguments)
    assert words in str(caught.value)


def test_looking_from_the_target_is_refused():
    with pytest.raises(InputError, match="eye and target apart"):
        Camera.look_at([1, 2, 3], [1, 2, 3], width=4, height=4, fov_y=1.0)
