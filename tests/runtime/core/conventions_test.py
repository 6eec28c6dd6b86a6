"""The conventions stated in ``rnd_runtime/__init__.py``, each in literal numbers.

Everything here is worked out by hand from that page, so a change of convention fails here first.
"""

import numpy as np
from numpy.testing import assert_allclose

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_quaternion, rotation_6d
from rnd_runtime.motion.motion import Z_UP_TO_Y_UP
from rnd_runtime.motion.skeleton import Skeleton, bone_transforms
from rnd_runtime.shading.light import Light, texel_directions

HALF_TURN, QUARTER = np.pi, np.pi / 2
EXACT = 1e-12  # float64 round-off of a few operations on numbers near 1


def _project(camera: Camera, point: list[float]) -> np.ndarray:
    pixel = camera.K @ (camera.world_to_camera @ [*point, 1.0])[:3]
    return pixel[:2] / pixel[2]


def test_world_is_right_handed_and_y_is_up():
    """A quarter turn about X takes Y to Z, as in every right-handed frame; a Z-up file's Z becomes our Y."""
    assert_allclose(axis_angle_to_matrix([QUARTER, 0, 0]) @ [0, 1, 0], [0, 0, 1], atol=EXACT)
    assert (Z_UP_TO_Y_UP @ [0, 0, 1] == [0, 1, 0]).all()
    assert (Z_UP_TO_Y_UP @ [1, 0, 0] == [1, 0, 0]).all()
    assert np.linalg.det(Z_UP_TO_Y_UP) == 1


def test_camera_axes_are_right_down_forward():
    """From 3 m in front of a person who faces +Z: their left hand (+X) is on the right of the picture."""
    camera = Camera.look_at([0, 1, 3], [0, 1, 0], width=200, height=100, fov_y=2 * np.arctan(0.5))
    assert_allclose(camera.K, [[100, 0, 100], [0, 100, 50], [0, 0, 1]], atol=EXACT)
    assert_allclose(camera.position, [0, 1, 3], atol=EXACT)
    assert_allclose((camera.world_to_camera @ [0, 1, 0, 1])[:3], [0, 0, 3], atol=EXACT)
    assert_allclose(_project(camera, [0, 1, 0]), [100, 50], atol=EXACT)  # the middle of the picture
    assert_allclose(_project(camera, [0.3, 1, 0]), [110, 50], atol=EXACT)  # +X is right
    assert_allclose(_project(camera, [0, 1.3, 0]), [100, 40], atol=EXACT)  # up is a smaller row


def test_pixel_centres_lie_at_a_half():
    """A 1 × 1 picture sees straight ahead in its only pixel's centre, (0.5, 0.5)."""
    camera = Camera.look_at([0, 0, 1], [0, 0, 0], width=1, height=1, fov_y=1.0)
    assert_allclose(_project(camera, [0, 0, 0]), [0.5, 0.5], atol=EXACT)
    # doubling the grid keeps picture edges on picture edges: 0.5 of 1 is 1.0 of 2
    assert_allclose(_project(camera.resized(2, 2), [0, 0, 0]), [1.0, 1.0], atol=EXACT)


def test_quaternions_are_wxyz():
    assert_allclose(matrix_to_quaternion(np.eye(3)), [1, 0, 0, 0], atol=EXACT)
    assert_allclose(matrix_to_quaternion(np.diag([1.0, -1, -1])), [0, 1, 0, 0], atol=EXACT)


def test_six_numbers_of_a_rotation_are_its_first_two_columns():
    quarter_about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert rotation_6d(quarter_about_z).tolist() == [0, 1, 0, -1, 0, 0]


def test_posing():
    """G_k = G_parent · [R_k | rest_k − rest_parent]; the root turns about its rest position, then moves."""
    skeleton = Skeleton(("root", "arm"), [-1, 0], [[0, 1, 0], [0.5, 1, 0]])
    rotations = axis_angle_to_matrix([[0, QUARTER, 0], [0, 0, QUARTER]])  # root: X to −Z; arm: X to Y
    arm = skeleton.joint_transforms(rotations, [10.0, 0, 0])[1]
    # the arm's joint, 0.5 m along X from the root, is turned to −Z and moved by 10 m
    assert_allclose(arm[:3, 3], [10, 1, -0.5], atol=EXACT)
    # a hand 0.3 m further along the arm points up: X → Y by the arm, Y stays by the root
    assert_allclose(arm @ [0.3, 0, 0, 1], [10, 1.3, -0.5, 1], atol=EXACT)
    # the same hand through the bone's transform, from where it is at rest
    bone = bone_transforms(skeleton, rotations, [10.0, 0, 0])[1]
    assert_allclose(bone @ [0.8, 1, 0, 1], [10, 1.3, -0.5], atol=1e-6)


def test_probe_has_x_in_the_centre_z_to_its_right_and_y_on_top():
    """u = 0.5 + atan2(z, x) / 2π, v = acos(y) / π."""
    directions = texel_directions(180, 360)  # a degree a texel
    expected = {
        (90, 180): [1, 0, 0],
        (90, 270): [0, 0, 1],
        (90, 90): [0, 0, -1],
        (90, 0): [-1, 0, 0],
        (0, 180): [0, 1, 0],
        (179, 180): [0, -1, 0],
    }
    for (row, column), axis in expected.items():
        assert directions[row, column] @ axis > np.cos(np.radians(1)), (row, column)


def test_yaw_turns_a_light_from_x_towards_z():
    radiance = np.zeros((8, 16, 3), np.float32)
    radiance[3:5, 7:9] = 1.0  # around the centre: +X
    light = Light(radiance, yaw=QUARTER)
    assert light.sample([0, 0, 1])[0] == 1.0
    assert light.sample([1, 0, 0])[0] == light.sample([0, 0, -1])[0] == 0.0
    assert_allclose(light.rotation @ [1, 0, 0], [0, 0, 1], atol=EXACT)


def test_srgb():
    """18 % grey is byte 118; white is 255; the toe is straight."""
    assert to_bytes(linear_to_srgb([0, 0.002, 0.18, 1])).tolist() == [0, 7, 118, 255]


def test_angles_are_radians():
    assert_allclose(axis_angle_to_matrix([0, 0, HALF_TURN]), np.diag([-1.0, -1, 1]), atol=EXACT)
