"""rnd-convert camera: cameras of nerfstudio, glTF and USD become ours."""

from __future__ import annotations

import json
import math
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rnd_runtime.core.camera import Camera
from rnd_viewer.convert.cli import main
from rnd_viewer.inputs.cameras import file_path

GL = np.diag([1.0, -1, -1, 1])  # OpenGL's camera axes
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # ours → a Z-up world


def _camera(eye=(1.0, 2.0, 4.0), fov: float = 0.7) -> Camera:
    return Camera.look_at(list(eye), [0.1, 0.9, 0.0], width=640, height=360, fov_y=fov)


def _converted(source, out, *words) -> list[Camera]:
    assert main(["camera", str(source), "--out", str(out), *words]) == 0
    count = len(json.loads(out.read_text()).get("cameras", [0]))
    path = file_path(str(out), None, range(count))
    return [path(k, 0.0) for k in range(count)]


def _assert_same(got: Camera, wanted: Camera) -> None:
    assert (got.width, got.height) == (wanted.width, wanted.height)
    np.testing.assert_allclose(got.world_to_camera, wanted.world_to_camera, atol=1e-5)
    np.testing.assert_allclose(got.K, wanted.K, atol=1e-2)


@pytest.mark.parametrize("digits", ["03d", "d"])
@pytest.mark.parametrize("shared", [True, False])
def test_transforms_of_nerfstudio(shared, digits, tmp_path):
    """Camera-to-world in OpenGL's axes in a Z-up world; intrinsics for all frames or for each."""
    wanted = [_camera((k, 2, 4), 0.7 if shared else 0.5 + 0.1 * k) for k in range(11)]
    lenses = [
        {"fl_x": c.K[0, 0], "fl_y": c.K[1, 1], "cx": c.K[0, 2], "cy": c.K[1, 2], "w": 640, "h": 360} for c in wanted
    ]
    frames = [
        {
            "file_path": f"images/{k:{digits}}.png",
            "transform_matrix": (Z_UP @ np.linalg.inv(c.world_to_camera) @ GL).tolist(),
        }
        for k, c in enumerate(wanted)
    ]
    document = {**lenses[0], "frames": frames[::-1]}
    if not shared:
        document = {"frames": [{**frame, **lens} for frame, lens in zip(frames, lenses)][::-1]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    got = _converted(tmp_path / "transforms.json", tmp_path / "out.json")
    assert len(got) == 11
    for ours, theirs in zip(got, wanted):
        _assert_same(ours, theirs)


def test_an_angle_of_view_is_enough(tmp_path):
    frame = {"file_path": "0", "transform_matrix": (Z_UP @ np.linalg.inv(_camera().world_to_camera) @ GL).tolist()}
    angle = 2 * math.atan(320 / _camera().K[0, 0])
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": [frame]}))
    (got,) = _converted(tmp_path / "transforms.json", tmp_path / "out.json", "--size", "640x360")
    _assert_same(got, _camera())


def _glb(path, times: np.ndarray, cameras: list[Camera], spline: bool = False) -> None:
    """A camera below a node that is rotated and moved, as Blender writes it, animated by rotation and translation.

    A ``spline`` has tangents of zero. A .gltf has its buffer in a file beside it.
    """
    above = np.eye(4)
    above[:3, :3], above[:3, 3] = Rotation.from_euler("y", 30, degrees=True).as_matrix(), [0.2, 0, -0.1]
    local = [np.linalg.inv(above) @ np.linalg.inv(c.world_to_camera) @ GL for c in cameras]
    rotations = np.array([Rotation.from_matrix(m[:3, :3]).as_quat() for m in local], "<f4")
    translations = np.array([m[:3, 3] for m in local], "<f4")
    start = {"translation": translations[0].tolist(), "rotation": rotations[0].tolist()}
    if spline:
        rotations, translations = (np.stack([0 * v, v, 0 * v], 1) for v in (rotations, translations))
    how = {"interpolation": "CUBICSPLINE"} if spline else {}
    chunks = [times.astype("<f4").tobytes(), rotations.tobytes(), translations.tobytes()]
    starts = np.cumsum([0, *map(len, chunks)])
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"translation": above[:3, 3].tolist(), "rotation": Rotation.from_matrix(above[:3, :3]).as_quat().tolist()}
            | {"children": [1]},
            {"name": "shot", "camera": 0, **start},
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 640 / 360, "znear": 0.1}}],
        "buffers": [{"byteLength": int(starts[-1])}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(starts[k]), "byteLength": len(chunk)} for k, chunk in enumerate(chunks)
        ],
        "accessors": [
            {"bufferView": k, "componentType": 5126, "count": len(times) * (3 if spline and k else 1), "type": kind}
            for k, kind in enumerate(("SCALAR", "VEC4", "VEC3"))
        ],
        "animations": [
            {
                "samplers": [{"input": 0, "output": 1, **how}, {"input": 0, "output": 2, **how}],
                "channels": [
                    {"sampler": 0, "target": {"node": 1, "path": "rotation"}},
                    {"sampler": 1, "target": {"node": 1, "path": "translation"}},
                ],
            }
        ],
    }
    if path.suffix == ".gltf":
        document["buffers"][0]["uri"] = "keys.bin"
        path.with_name("keys.bin").write_bytes(b"".join(chunks))
        path.write_text(json.dumps(document))
        return
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(chunks)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    parts = [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(data), b"BIN\0"), data]
    path.write_bytes(b"".join(parts))


def test_an_animated_camera_of_gltf(tmp_path):
    wanted = [_camera((0.2 * k, 2, 4)) for k in range(4)]
    _glb(tmp_path / "a.glb", 0.6 + np.arange(4) / 24, wanted)  # Blender's keys begin where its frames do
    words = ("--size", "640x360", "--fps", "24")
    got = _converted(tmp_path / "a.glb", tmp_path / "out.json", *words)
    assert len(got) == 4
    for ours, theirs in zip(got, wanted):
        _assert_same(ours, theirs)
    assert len(_converted(tmp_path / "a.glb", tmp_path / "twice.json", "--size", "640x360", "--fps", "48")) == 7


@pytest.mark.parametrize(("spline", "share"), [(False, 1 / 4), (True, 5 / 32)])
def test_between_keys_a_camera_of_gltf_rotates_evenly_or_along_its_spline(tmp_path, spline, share):
    """A quarter after a key: a quarter of the way and of the angle, of splines 3t² − 2t³ of the way."""
    ends = [_camera((0, 2, 4)), _camera((4, 2, 0))]
    _glb(tmp_path / "a.gltf", np.arange(2), ends, spline)
    first, second, *_, last = _converted(tmp_path / "a.gltf", tmp_path / "out.json", "--size", "640x360", "--fps", "4")
    start, now, end = (np.linalg.inv(camera.world_to_camera) for camera in (first, second, last))
    np.testing.assert_allclose(now[:3, 3], (1 - share) * start[:3, 3] + share * end[:3, 3], atol=1e-6)
    angle, whole = (Rotation.from_matrix(start[:3, :3].T @ m[:3, :3]).magnitude() for m in (now, end))
    if not spline:  # whose quaternions lie on the chord
        assert angle == pytest.approx(share * whole, rel=1e-5)


@pytest.mark.parametrize(("size", "shown"), [("640x640", (640, 360)), ("720x360", (640, 360)), ("320x180", (320, 180))])
def test_a_camera_of_gltf_is_not_stretched_to_other_sizes(tmp_path, size, shown):
    """An image of another aspect has square pixels and holds all that the camera sees."""
    _glb(tmp_path / "a.glb", np.zeros(1), [_camera()])
    (camera,) = _converted(tmp_path / "a.glb", tmp_path / "out.json", "--size", size)
    np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], 0.5 * shown[1] / math.tan(0.35))
    np.testing.assert_allclose(camera.K[:2, 2], [camera.width / 2, camera.height / 2])


def test_a_camera_of_usd_whatever_its_axes_and_unit(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    wanted = [_camera((0.2 * k, 2, 4)) for k in range(3)]
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetStartTimeCode(5)
    stage.SetEndTimeCode(7)
    lens = UsdGeom.Camera.Define(stage, "/world/shot")
    lens.CreateHorizontalApertureAttr(36.0)
    lens.CreateVerticalApertureAttr(36.0 * 360 / 640)
    lens.CreateFocalLengthAttr(36.0 * wanted[0].K[0, 0] / 640)
    transform = lens.AddTransformOp()
    for code, camera in enumerate(wanted, 5):
        pose = Z_UP @ np.linalg.inv(camera.world_to_camera) @ GL
        pose[:3, 3] *= 100
        transform.Set(Gf.Matrix4d(pose.T.tolist()), code)
    stage.GetRootLayer().Save()
    got = _converted(tmp_path / "shot.usda", tmp_path / "out.json", "--size", "640x360")
    assert len(got) == 3
    for ours, theirs in zip(got, wanted):
        _assert_same(ours, theirs)


_FRAME = {"file_path": "0", "transform_matrix": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", '{"K": []}', "takes it as it is"),
        ("a.json", '{"cameras": {}, "frames": [{"camera": "cam00"}]}', "takes it as it is"),  # a capture
        ("a.json", '{"frames": []}', "no camera"),
        ("a.json", json.dumps({"frames": [_FRAME]}), "fl_x or camera_angle_x"),
        ("a.json", json.dumps({"fl_x": 500, "k1": 0.2, "frames": [_FRAME]}), "undistort"),
        ("a.json", json.dumps({"fl_x": 500, "frames": [{"transform_matrix": [[0] * 4] * 4}]}), "a rotation"),
        ("a.json", "[1]", "an object"),
        ("a.json", "{", "cannot be read"),
        ("a.gltf", '{"asset": {}, "nodes": []}', "no camera"),
        ("a.gltf", '{"nodes": []}', "a glTF document"),
        ("a.gltf", json.dumps({"asset": {}, "nodes": [{"camera": 0, "name": name} for name in "xy"]}), "x, y"),
        ("a.gltf", '{"asset": {}, "nodes": [{"camera": 0}], "cameras": [{"type": "orthographic"}]}', "perspective"),
        ("a.glb", "glTF", "cannot be read"),
        ("a.blend", "BLENDER", "glTF"),
    ],
)
def test_what_is_no_camera_is_one_line(name, content, said, tmp_path, capsys):
    (tmp_path / name).write_text(content)
    assert main(["camera", str(tmp_path / name), "--out", str(tmp_path / "out.json")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not (tmp_path / "out.json").exists(), error
