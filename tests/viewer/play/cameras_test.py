"""The cameras of the player: framing, orbit, files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path, orbit_path
from rnd_viewer.inputs.cameras import file_path
from support.play_fakes import fake_motion, fake_skeleton

ONE = range(1)
VIEW = CameraOptions(width=320, height=200, fov_y=0.6, elevation=0.1)


def _sphere_margins(framing, camera: Camera) -> np.ndarray:
    """Distance in m [P, 4] of every padded joint's sphere inside each of the frustum's planes."""
    points = framing.joints @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]])
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(camera.K).T
    planes = np.cross(rays, np.roll(rays, -1, axis=0))
    return points @ (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T - framing.padding


def _turned(yaw: float):
    motion = fake_motion()
    rotations = motion.rotations.copy()
    rotations[:, 0] = axis_angle_to_matrix([0, yaw, 0]) @ rotations[:, 0]
    return replace(motion, rotations=rotations)


@pytest.mark.parametrize("view", [VIEW, CameraOptions(200, 320, 1.2, -0.4), CameraOptions(256, 256, 0.3, 1.0)])
def test_front_camera_shows_the_whole_motion_and_no_more(view):
    framing = frame_motion(fake_skeleton(), fake_motion())
    margins = _sphere_margins(framing, front_path(framing, view)(0, 0.0))
    assert margins.min() == pytest.approx(0, abs=1e-9)  # something touches a border, nothing crosses one


def test_orbit_shows_the_whole_motion_from_everywhere():
    framing = frame_motion(fake_skeleton(), fake_motion())
    camera_at = orbit_path(framing, VIEW, 6.0)
    least = min(_sphere_margins(framing, camera_at(0, time)).min() for time in np.linspace(0, 6, 49))
    assert least > -1e-3  # between the sampled azimuths a joint may come a millimetre nearer


@pytest.mark.parametrize("yaw", [0.0, 1.3, np.pi])
def test_front_camera_looks_the_body_in_the_face(yaw):
    framing = frame_motion(fake_skeleton(), _turned(yaw))
    camera = front_path(framing, CameraOptions(64, 64, 0.6, 0.0))(0, 0.0)
    to_camera = (camera.position - framing.centre) / np.linalg.norm(camera.position - framing.centre)
    np.testing.assert_allclose(to_camera, [np.sin(yaw), 0, np.cos(yaw)], atol=1e-9)


def test_orbit_starts_in_front_and_turns_towards_the_left():
    framing = frame_motion(fake_skeleton(), fake_motion())
    view = replace(VIEW, distance=3.0, elevation=0.0)
    camera_at = orbit_path(framing, view, 8.0)
    np.testing.assert_allclose(camera_at(0, 0.0).position, framing.centre + np.array([0, 0, 3]), atol=1e-9)
    np.testing.assert_allclose(camera_at(0, 2.0).position, framing.centre + np.array([3, 0, 0]), atol=1e-9)
    np.testing.assert_allclose(camera_at(0, 8.0).position, camera_at(0, 0.0).position, atol=1e-9)
    np.testing.assert_allclose(
        orbit_path(framing, view, -8.0)(0, 2.0).position, framing.centre - np.array([3, 0, 0]), atol=1e-9
    )


def test_framing_is_in_the_middle_and_holds_every_joint():
    framing = frame_motion(fake_skeleton(), fake_motion())
    assert len(framing.joints) == 12 * 24
    offsets = framing.joints - framing.centre
    np.testing.assert_allclose(offsets.max(axis=0), -offsets.min(axis=0), atol=1e-12)
    assert 0.15 < framing.padding < 0.3
    assert framing.radius > np.linalg.norm(framing.joints - framing.centre, axis=1).max() + 0.15


def _record(width=40, height=20, shift=0.0) -> dict:
    pose = np.eye(4)
    pose[0, 3] = shift
    return {
        "width": width,
        "height": height,
        "K": [[50, 0, 21], [0, 50, 9], [0, 0, 1]],
        "world_to_camera": pose.tolist(),
    }


def _write(tmp_path, document) -> str:
    file = tmp_path / "cameras.json"
    file.write_text(document if isinstance(document, str) else json.dumps(document))
    return str(file)


def test_camera_file_with_one_camera_serves_every_frame(tmp_path):
    camera_at = file_path(_write(tmp_path, _record()), None, range(100))
    assert camera_at(0, 0.0) is camera_at(99, 3.3)
    np.testing.assert_array_equal(camera_at(0, 0.0).K, _record()["K"])


@pytest.mark.parametrize(("size", "expected"), [((80, None), (80, 40)), ((20, 10), (20, 10))])
def test_size_resamples_a_camera_file(tmp_path, size, expected):
    camera = file_path(_write(tmp_path, _record()), size, ONE)(0, 0.0)
    assert (camera.width, camera.height) == expected
    np.testing.assert_allclose(camera.K[:2], np.array(_record()["K"])[:2] * expected[0] / 40)


def test_camera_file_with_a_list_has_one_for_each_frame(tmp_path):
    file = _write(tmp_path, {"cameras": [_record(shift=0), _record(shift=1)]})
    camera_at = file_path(file, None, range(2))
    assert camera_at(1, 0.0).world_to_camera[0, 3] == 1
    message = r"cameras\.json: cameras: expected one, or one for each of 3 frames, got 2"
    with pytest.raises(InputError, match=message):
        file_path(file, None, range(2, 3))


def test_cameras_of_a_capture_are_chosen_by_name(tmp_path):
    file = _write(tmp_path, {"schema": "x", "cameras": {"a": _record(shift=1), "b": _record(shift=2)}})
    assert file_path(f"{file}:b", None, ONE)(0, 0.0).world_to_camera[0, 3] == 2
    for name in ("", ":c"):
        with pytest.raises(InputError, match="one of a, b"):
            file_path(file + name, None, ONE)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "cannot be read"),
        ({"width": 4}, "cannot be read"),
        (_record() | {"fov": 3}, "fov"),
        (_record() | {"K": [[1, 0], [0, 1, 0], [0, 0, 1]]}, "rows of one length"),
        (_record() | {"world_to_camera": (2 * np.eye(4)).tolist()}, "rigid"),
        (_record() | {"K": [[50, 3, 21], [0, 50, 9], [0, 0, 1]]}, "fx 0 cx, 0 fy cy, 0 0 1"),
        (_record(16385, 4), "at most 16384 a side, got 16385 x 4"),
        ({"cameras": []}, "no camera"),
        ('{"cameras":' + "[" * 100_000, "cannot be read"),
    ],
)
def test_broken_camera_file_is_refused_in_one_line(tmp_path, document, message):
    with pytest.raises(InputError, match=message) as caught:
        file_path(_write(tmp_path, document), None, ONE)
    assert "cameras.json" in str(caught.value) and "\n" not in str(caught.value)


def test_a_name_is_refused_where_cameras_have_none(tmp_path):
    for document in (_record(), {"cameras": [_record()]}):
        with pytest.raises(InputError, match="its cameras have no names, got left"):
            file_path(_write(tmp_path, document) + ":left", None, ONE)


def test_a_folder_may_be_called_json(tmp_path):
    (tmp_path / "shots.json.d").mkdir()
    text = _write(tmp_path / "shots.json.d", _record(40, 20))
    assert file_path(text, None, range(4))(3, 0.1).width == 40


def test_missing_camera_file_and_other_aspect_are_refused(tmp_path):
    with pytest.raises(InputError, match="camera file not found"):
        file_path(str(tmp_path / "none.json"), None, ONE)
    with pytest.raises(InputError, match="aspect, 40x20, got 30x30"):
        file_path(_write(tmp_path, _record()), (30, 30), ONE)
