"""Captures: what is read, what every picture means, and what is refused with both values."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.capture import Body, Capture, CaptureLight, Frame, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from support.paths import SHARED

SHARED_DATA = SHARED / "data" / "capture"
H, W, FRAMES = 4, 6, 3
IMAGE = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
NORMALS = np.array([[0.0, 0, -1], [0.6, 0, -0.8], [0, -0.6, -0.8], [1, 0, 0]])


def _body() -> Body:
    skeleton = Skeleton(("root", "arm"), [-1, 0], [[0, 1, 0], [0.5, 1, 0]])
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    weights = np.array([[1.0, 0], [0.25, 0.75], [0.5, 0.5], [0, 1]], np.float32)
    return Body(vertices, np.array([[0, 1, 2], [0, 2, 3]]), weights, skeleton)


def _frame(**changes: object) -> Frame:
    fields = {
        **{"image": "images/a.png", "mask": "masks/a.png", "normal": "normals/a.png"},
        **{"camera": "front", "frame": 0, "split": "train", "light": "sky"},
    }
    return Frame(**(fields | changes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A capture of two pictures, written by our own writer."""
    camera = Camera.look_at([0, 1, 3], [0, 1, 0], width=W, height=H, fov_y=0.8)
    axis_angles = np.random.default_rng(1).normal(size=(FRAMES, 2, 3))
    body = _body()
    motion = Motion(axis_angle_to_matrix(axis_angles), np.ones((FRAMES, 3)), 30.0, body.skeleton.names)
    frames = (_frame(), _frame(frame=2, split="novel_pose", light=None, normal=None, normal_gt="normals/a.png"))
    sky = CaptureLight("lights/sky.exr", (1.0, 2.0, 3.0), 0.5)
    save_capture(Capture(tmp_path, {"front": camera}, {"sky": sky}, body, motion, frames), subject="nobody at all")
    write_image(tmp_path / "images" / "a.png", IMAGE)
    write_image(tmp_path / "masks" / "a.png", IMAGE[..., 0])
    normals = np.zeros((H, W, 3), np.uint8)
    normals[0, :4] = to_bytes((NORMALS + 1) / 2)
    normals[1, :] = 128
    write_image(tmp_path / "normals" / "a.png", normals)
    write_image(tmp_path / "lights" / "sky.exr", np.full((4, 8, 3), 0.5, np.float32))
    return tmp_path


def _edit(folder: Path, *keys: object, value: object = None, remove: bool = False) -> None:
    """Change one entry of capture.json."""
    record = json.loads((folder / "capture.json").read_text())
    place = record
    for key in keys[:-1]:
        place = place[key]
    if remove:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    (folder / "capture.json").write_text(json.dumps(record))


def _refusal(folder: Path, **arguments: object) -> str:
    with pytest.raises(InputError) as caught:
        load_capture(folder, **arguments)
    message = str(caught.value)
    assert str(folder) in message and "\n" not in message
    return message


# Reading


def test_what_was_saved_is_read(folder):
    capture = load_capture(folder)
    body = _body()
    assert capture.fps == 30.0 and capture.folder == folder
    assert capture.frames[0] == _frame() and capture.frames[1].light is None
    assert capture.body.skeleton.names == ("root", "arm")
    assert (capture.body.vertices == body.vertices).all() and (capture.body.faces == body.faces).all()
    assert (capture.body.skinning_weights == body.skinning_weights).all()
    assert capture.motion.frame_count == FRAMES and (capture.motion.translations == 1).all()
    camera = Camera.look_at([0, 1, 3], [0, 1, 0], width=W, height=H, fov_y=0.8)
    assert (capture.cameras["front"].K == camera.K).all()
    assert (capture.cameras["front"].world_to_camera == camera.world_to_camera).all()
    assert json.loads((folder / "capture.json").read_text())["subject"] == "nobody at all"


def test_splits_keep_the_order(folder):
    capture = load_capture(folder / "capture.json")
    assert capture.split("train") == [capture.frames[0]]
    assert capture.split("novel_pose") == [capture.frames[1]]
    assert capture.split("relight") == []


def test_saving_twice_gives_the_same_bytes(folder):
    names = ("capture.json", "body.npz", "motion.npz")
    first = [(folder / name).read_bytes() for name in names]
    capture = load_capture(folder)
    save_capture(capture, subject="nobody at all")
    second = [(folder / name).read_bytes() for name in names]
    assert first[:2] == second[:2]
    assert_allclose(load_capture(folder).motion.rotations, capture.motion.rotations, atol=1e-12)


def test_pictures_are_decoded(folder):
    capture = load_capture(folder)
    pictures = capture.load_frame(capture.frames[0])
    assert pictures.image_srgb.dtype == pictures.mask.dtype == pictures.normal.dtype == np.float32
    assert (pictures.image_srgb == IMAGE.astype(np.float32) / np.float32(255)).all()
    assert (to_bytes(pictures.mask) == IMAGE[..., 0]).all()
    assert_allclose(pictures.normal[0, :4], NORMALS, atol=1 / 127)  # 8 bit over [−1, 1]
    assert_allclose(np.linalg.norm(pictures.normal[0, :4], axis=-1), 1, atol=1e-6)
    assert (pictures.normal[1:] == 0).all() and (pictures.normal[0, 4:] == 0).all()
    assert pictures.normal_gt is None and pictures.albedo_srgb is None
    second = capture.load_frame(capture.frames[1])
    assert second.normal is None and (second.normal_gt == pictures.normal).all()


def test_sixteen_bit_pictures_keep_their_precision(folder):
    pixels = np.random.default_rng(3).integers(0, 65536, (H, W, 3), np.uint16)
    write_image(folder / "images" / "a.png", pixels)
    capture = load_capture(folder)
    assert_allclose(capture.load_frame(capture.frames[0]).image_srgb, pixels / 65535, rtol=1e-6)


def test_light_is_file_times_scale_turned_by_yaw(folder):
    light = load_capture(folder).load_light("sky")
    assert (light.radiance == np.float32([0.5, 1.0, 1.5])).all() and light.yaw == 0.5
    with pytest.raises(InputError, match="light: expected sky, got sun"):
        load_capture(folder).load_light("sun")


def test_another_motion_can_take_the_place(folder):
    (folder / "motion.npz").rename(folder / "noisy.npz")
    assert load_capture(folder, motion_file="noisy.npz").motion.source == str(folder / "noisy.npz")
    assert "motion.npz" in _refusal(folder)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("names", [("root", "arm"), ("root", "hand", "arm")])
def test_an_avatar_that_rests_elsewhere_is_where_the_pictures_have_it(folder, names, up):
    axis_angles = np.random.default_rng(1).normal(size=(FRAMES, 6))
    trans = np.random.default_rng(2).normal(size=(FRAMES, 3))
    np.savez(folder / "motion.npz", poses=axis_angles, trans=trans, mocap_framerate=30, up_axis=up)
    capture = load_capture(folder)
    own = capture.body.skeleton
    root = own.rest_joints[0] + capture.motion.translations
    rest = np.random.default_rng(3).normal(size=(len(names), 3))
    skeleton = Skeleton(names, np.arange(len(names)) - 1, rest)
    motion = capture.motion_for(skeleton)
    assert motion.joint_names == names
    assert_allclose(motion.translations + rest[0], root, atol=1e-12)


def test_motion_columns_follow_the_body_without_names(folder):
    """motion.npz has no joint names: its columns are the body's joints."""
    axis_angles = np.random.default_rng(1).normal(size=(FRAMES, 6))
    np.savez(folder / "motion.npz", poses=axis_angles, trans=np.zeros((FRAMES, 3)), mocap_framerate=30)
    motion = load_capture(folder).motion
    assert_allclose(motion.rotations, axis_angle_to_matrix(axis_angles.reshape(-1, 2, 3)), atol=1e-12)


def test_capture_without_measured_lights(folder):
    _edit(folder, "lights", remove=True)
    _edit(folder, "frames", 0, "light", remove=True)
    assert load_capture(folder).lights == {}


# Refusals


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("schema",), "rnd-capture/2", ["schema", "rnd-capture/1", "rnd-capture/2"]),
        (("schema",), 1, ["schema", "got 1"]),
        (("fps",), 0, ["$.fps"]),
        (("fps",), 25.0, ["fps of the motion", "25 as in capture.json", "got 30"]),
        (("fps",), "30", ["float", "$.fps"]),
        (("frames",), [], ["$.frames"]),
        (("frames", 1, "frame"), -1, ["$.frames[1].frame", ">= 0"]),
        (("frames", 1, "frame"), 3, ["frame 3", "3 frames", "got 3"]),
        (("frames", 1, "frame"), 1.5, ["$.frames[1].frame", "int"]),
        (("frames", 1, "split"), "test", ["$.frames[1].split", "test"]),
        (("frames", 1, "camera"), "back", ["frame 2", "camera", "front", "back"]),
        (("frames", 0, "light"), "sun", ["frame 0", "light", "sky", "sun"]),
        (("frames", 0, "normals"), "normals/a.png", ["normals", "$.frames[0]"]),
        (("frames", 0, "image"), "../a.png", ["relative path", "../a.png"]),
        (("frames", 0, "image"), "images/../../a.png", ["relative path"]),
        (("frames", 0, "image"), "/etc/passwd", ["relative path", "/etc/passwd"]),
        (("frames", 0, "image"), "..\\a.png", ["relative path"]),
        (("frames", 0, "image"), "", ["relative path"]),
        (("frames", 0, "mask"), "masks/none.png", ["frame 0", "none.png", "not found"]),
        *(((part,), "x" * 10_000, ["not found", "File name too long"]) for part in ("body", "motion")),
        (("body",), "../body.npz", ["relative path"]),
        (("body",), "none.npz", ["none.npz", "not found"]),
        (("lights", "sky", "file"), "/sky.exr", ["relative path"]),
        (("lights", "sky", "file"), "lights/none.exr", ["none.exr", "not found"]),
        (("lights", "sky", "scale"), [1, 1], ["$.lights[...].scale"]),
        (("lights", "sky", "scale"), [1, 1, -1], ["lights.sky.scale", "negative"]),
        (("cameras", "front", "K"), [[1, 0], [0, 1]], ["$.cameras[...].K"]),
        (("cameras", "front", "K"), [[0, 0, 1], [0, 1, 1], [0, 0, 1]], ["cameras.front", "focal"]),
        (("cameras", "front", "world_to_camera"), np.diag([2, 1, 1, 1]).tolist(), ["cameras.front", "rigid"]),
        (("cameras", "front", "world_to_camera"), np.diag([-1, 1, 1, 1]).tolist(), ["cameras.front", "rigid"]),
        (("cameras", "front", "width"), 7, ["frame 0", "size of image", "7 x 4", "got 6 x 4", "front"]),
        (("cameras", "front", "width"), 0, ["cameras.front", "0 x 4"]),
        (("cameras", "front", "colour"), "red", ["colour"]),
    ],
)
def test_bad_entries_are_named(folder, keys, value, words):
    _edit(folder, *keys, value=value)
    message = _refusal(folder)
    for word in words:
        assert word in message, message


@pytest.mark.parametrize("key", ["schema", "fps", "cameras", "body", "motion", "frames"])
def test_missing_entries_are_named(folder, key):
    _edit(folder, key, remove=True)
    assert key in _refusal(folder)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"schema": "rnd-capture/1"'])
def test_what_is_no_json_object_is_refused(folder, content):
    (folder / "capture.json").write_bytes(content)
    assert "capture.json" in _refusal(folder)


@pytest.mark.parametrize("kind", ["image", "mask", "normal"])
def test_pictures_of_another_size_name_frame_and_both_values(folder, kind):
    channels = 1 if kind == "mask" else 3
    write_image(folder / f"{kind}s" / "a.png", np.zeros((2, 9, channels), np.uint8))
    message = _refusal(folder)
    for words in ("frame 0", f"size of {kind}", "6 x 4", "9 x 2", "a.png"):
        assert words in message, message


@pytest.mark.parametrize(
    ("kind", "channels", "words"),
    [
        ("image", 4, ["channels of image", "3, no alpha", "4 (RGBA)"]),
        ("image", 1, ["channels of image", "got 1"]),
        ("mask", 3, ["channels of mask", "expected 1", "3 (RGB)"]),
    ],
)
def test_other_channels_are_refused(folder, kind, channels, words):
    write_image(folder / f"{kind}s" / "a.png", np.zeros((H, W, channels), np.uint8))
    message = _refusal(folder)
    for word in ["frame 0", *words]:
        assert word in message, message


def test_float_pictures_and_pictures_turned_by_exif_are_refused(folder):
    write_image(folder / "images" / "a.exr", np.zeros((H, W, 3), np.float32))
    _edit(folder, "frames", 0, "image", value="images/a.exr")
    message = _refusal(folder)
    assert "frame 0" in message and "8 or 16 bit" in message and "float" in message
    spec = oiio.ImageSpec(W, H, 3, "uint8")
    spec.attribute("Orientation", 6)
    target = oiio.ImageOutput.create(str(folder / "images" / "a.jpg"))
    assert target.open(str(folder / "images" / "a.jpg"), spec) and target.write_image(IMAGE) and target.close()
    _edit(folder, "frames", 0, "image", value="images/a.jpg")
    message = _refusal(folder)
    assert "frame 0" in message and "orientation 1, got 6" in message


def test_picture_cut_short_names_its_frame_when_read(folder):
    noise = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
    write_image(folder / "images" / "a.png", noise)
    content = (folder / "images" / "a.png").read_bytes()
    (folder / "images" / "a.png").write_bytes(content[: len(content) - 40])
    capture = load_capture(folder)
    with pytest.raises(InputError) as caught:
        capture.load_frame(capture.frames[0])
    assert "frame 0" in str(caught.value) and "a.png" in str(caught.value)


def test_motion_of_another_joint_count_is_refused_with_both(folder):
    np.savez(folder / "motion.npz", poses=np.zeros((FRAMES, 72)), trans=np.zeros((FRAMES, 3)), fps=30)
    message = _refusal(folder)
    assert "2 joints (6 columns)" in message and "24 joints (72 columns)" in message


def _save_body(folder: Path, **changes: object) -> None:
    with np.load(folder / "body.npz") as archive:
        members = dict(archive)
    for name, value in changes.items():
        if value is None:
            del members[name]
        else:
            members[name] = np.asarray(value)
    np.savez(folder / "body.npz", **members)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"skinning_weights": [[1, 0], [1, 1], [1, 0], [1, 0]]}, ["vertex 1", "sum of 1", "got 2"]),
        ({"skinning_weights": [[1, 0], [1, 0], [1.5, -0.5], [1, 0]]}, ["vertex 2", "not negative"]),
        ({"skinning_weights": np.full((4, 2), np.nan)}, ["skinning_weights", "finite"]),
        ({"skinning_weights": np.ones((3, 2)) / 2}, ["skinning_weights", "4 vertices", "3×2"]),
        ({"skinning_weights": np.ones((4, 3)) / 3}, ["skinning_weights", "n×2", "4×3"]),
        ({"faces": [[0, 1, 4]]}, ["faces", "below 4", "got 4"]),
        ({"faces": [[0, 1, -1]]}, ["faces", "below 4", "got -1"]),
        ({"faces": [[0, 1, 1.5]]}, ["faces", "integers"]),
        ({"faces": [[0, 1]]}, ["faces", "n×3"]),
        ({"vertices": np.full((4, 3), np.inf)}, ["vertices", "finite"]),
        ({"vertices": np.zeros((0, 3))}, ["vertices", "at least one"]),
        ({"vertices": None}, ["vertices is missing"]),
        ({"joint_parents": [0, 0]}, ["parents", "earlier"]),
        ({"joint_parents": [-1, 0, 1]}, ["joint_parents", "2", "3"]),
        ({"joint_names": ["a", "a"]}, ["names", "each name once"]),
        ({"joint_names": np.array([{}, {}], object)}, ["joint_names", "Python objects"]),
        ({"rest_joints": np.zeros((2, 2))}, ["rest_joints", "2×3", "2×2"]),
        ({"rest_joints": np.zeros(2)}, ["shape of rest_joints", "2×3", "got 2"]),
    ],
)
def test_broken_bodies_are_refused(folder, changes, words):
    _save_body(folder, **changes)
    message = _refusal(folder)
    assert "body.npz" in message
    for word in words:
        assert word in message, message


def test_weights_rounded_by_their_writer_are_normalised(folder):
    _save_body(folder, skinning_weights=np.float16([[1, 0], [0.333, 0.668], [0.5, 0.499], [0.2, 0.8]]))
    weights = load_capture(folder).body.skinning_weights
    assert_allclose(weights.sum(1), 1, atol=1e-7)
