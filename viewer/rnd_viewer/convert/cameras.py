"""Cameras of other programs as the camera file of rnd-play.

============================  ====================================================================================
file                          what is read
============================  ====================================================================================
transforms.json               nerfstudio, instant-ngp: camera-to-world in OpenGL's axes, Z up; ``camera_angle_x`` or
                              ``fl_x``; one camera per entry of ``frames``, in the order of their file names
.gltf, .glb                   perspective cameras of the scene; an animated one gives a camera per frame from its
                              first key to its last. glTF has no lens shift
.usd, .usda, .usdc, .usdz     UsdGeom cameras, sampled at the stage's time codes, whatever its up axis and unit
============================  ====================================================================================

Blender writes .glb and .usd; its add-on of ours writes the file of rnd-play itself.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file, write_json
from rnd_runtime.motion.motion import Z_UP_TO_Y_UP

Floats = NDArray[np.float64]

FLIP = np.diag([1.0, -1, -1, 1])
"""OpenGL's camera axes (Y up, looking along −Z) ↔ OpenCV's"""
_SUFFIXES = ".json (transforms.json), .gltf, .glb, .usd, .usda, .usdc or .usdz"
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MAX_FRAMES = 200_000
_UNDISTORTED = 1e-4  # max coefficient of a lens that counts as a pinhole


def read_cameras(path: Path, name: str | None, size: tuple[int, int], fps: float) -> list[Camera]:
    """One camera, or one for each frame, of the file at ``path``.

    Args:
        name: of the camera, where the file holds several.
        size: (width, height) px, where the file states none.
        fps: of the frames at which an animated camera of a glTF is sampled.

    Raises:
        InputError: no such camera; or one that a pinhole cannot stand for.
    """
    file, suffix = existing_file(path, what="camera file"), path.suffix.lower()
    try:
        if suffix == ".json":
            return _of_transforms(_document(file.read_bytes()), size)
        if suffix in (".gltf", ".glb"):
            return _of_gltf(file, name, size, fps)
        if suffix in (".usd", ".usda", ".usdc", ".usdz"):
            return _of_usd(file, name, size)
    except InputError as error:
        raise error.at(file=file) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, struct.error) as error:
        raise InputError("camera file cannot be read", got=f"{type(error).__name__}: {error}", file=file) from error
    hint = "in Blender: File, Export, glTF or USD, or our add-on" if suffix == ".blend" else None
    raise InputError("camera file", expected=_SUFFIXES, got=path.name, hint=hint)


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write the file that ``--camera`` of rnd-play takes."""
    records = [
        {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "world_to_camera": camera.world_to_camera.tolist(),
        }
        for camera in cameras
    ]
    write_json(path, records[0] if len(records) == 1 else {"cameras": records})


def from_opengl(camera_to_world: Floats, K: Floats, size: tuple[int, int], *, z_up: bool = False) -> Camera:
    """The camera of an OpenGL camera-to-world [4, 4], in m; a uniform scale is taken out."""
    matrix = np.array(camera_to_world, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError("camera matrix", expected="4 x 4 finite numbers", got=list(matrix.shape))
    scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
    if scale < 1e-9:
        raise InputError("camera matrix", expected="a rotation", got=matrix[:3, :3].tolist())
    matrix[:3, :3] /= scale
    if z_up:
        matrix[:3] = Z_UP_TO_Y_UP @ matrix[:3]
    return Camera(*size, K, np.asarray(np.linalg.inv(matrix @ FLIP), np.float64))


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def _document(content: bytes) -> dict[str, Any]:
    document = json.loads(content)
    if not isinstance(document, dict):
        raise InputError("camera file", expected="an object", got=type(document).__name__)
    return document


def _of_transforms(document: Mapping[str, Any], size: tuple[int, int]) -> list[Camera]:
    if "cameras" in document or "frames" not in document:  # a capture has both
        ours = [name for name in ("cameras", "K") if name in document]
        got, hint = (ours[0], "--camera of rnd-play takes it as it is") if ours else ("none", None)
        raise InputError("camera file", expected="transforms.json with frames", got=got, hint=hint)
    frames = document["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError("frames of the camera file", expected="a list of objects", got="others")
    if not frames:
        raise InputError("camera file holds no camera")
    frames = sorted(frames, key=lambda frame: _by_numbers(str(frame.get("file_path", ""))))
    return [_of_entry({**document, **frame}, size) for frame in frames]


def _by_numbers(name: str) -> list[tuple[int, str]]:
    """A key that sorts "2.png" before "10.png"."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _of_entry(entry: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    model = entry.get("camera_model", "OPENCV")
    strongest = max((abs(float(entry.get(key, 0))) for key in _DISTORTION), default=0.0)
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE") or strongest > _UNDISTORTED:
        got = model if strongest <= _UNDISTORTED else f"distortion of {strongest:g}"
        raise InputError("camera model", expected="a pinhole", got=got, hint="undistort the images first")
    width, height = round(entry.get("w", size[0])), round(entry.get("h", size[1]))
    if "fl_x" in entry:
        fx = float(entry["fl_x"])
    elif "camera_angle_x" in entry:
        fx = 0.5 * width / math.tan(0.5 * float(entry["camera_angle_x"]))
    else:
        raise InputError("camera file", expected="fl_x or camera_angle_x", got="neither")
    fy = float(entry.get("fl_y", fx))
    K = _intrinsics(fx, fy, float(entry.get("cx", width / 2)), float(entry.get("cy", height / 2)))
    return from_opengl(np.array(entry["transform_matrix"], np.float64), K, (width, height), z_up=True)


def _of_gltf(file: Path, name: str | None, size: tuple[int, int], fps: float) -> list[Camera]:
    content, buffer = file.read_bytes(), b""
    if content[:4] == b"glTF":
        length = struct.unpack_from("<I", content, 12)[0]
        document, buffer = _document(content[20 : 20 + length]), content[28 + length :]
    else:
        document = _document(content)
    nodes = document.get("nodes", [])
    found = {
        str(node.get("name") or document["cameras"][node["camera"]].get("name") or index): index
        for index, node in enumerate(nodes)
        if "camera" in node
    }
    chosen = found[_named(list(found), name)]
    lens = document["cameras"][nodes[chosen]["camera"]]
    if lens["type"] != "perspective":
        raise InputError("camera", expected="perspective", got=lens["type"])
    width, height = size
    aspect = float(lens["perspective"].get("aspectRatio", width / height))
    high = 0.5 * min(height, width / aspect)  # square pixels, and all that the camera sees is in the image
    focal = high / math.tan(0.5 * float(lens["perspective"]["yfov"]))
    K = _intrinsics(focal, focal, width / 2, height / 2)
    parents = {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}
    chain = [chosen]
    while chain[-1] in parents:
        chain.append(parents[chain[-1]])
        if len(chain) > len(nodes):
            raise InputError("nodes", expected="a tree", got="a circle")
    tracks = _tracks(document, buffer, set(chain), file)
    keys = np.concatenate([keys for paths in tracks.values() for keys, _ in paths.values()] or [np.zeros(1)])
    frames = round(float(np.ptp(keys)) * fps) + 1
    if frames > _MAX_FRAMES:
        raise InputError("animation of the camera", expected=f"at most {_MAX_FRAMES} frames", got=frames)
    times = keys.min() + np.arange(frames) / fps
    cameras = []
    for time in times:
        world = np.eye(4)
        for index in chain:  # from the camera up
            world = _local(nodes[index], tracks.get(index, {}), float(time)) @ world
        cameras.append(from_opengl(world, K, size))
    return cameras


def _tracks(
    document: Mapping[str, Any], buffer: bytes, wanted: set[int], file: Path
) -> dict[int, dict[str, tuple[Floats, Floats]]]:
    """Keys, s, and values of each animated property of the ``wanted`` nodes."""
    tracks: dict[int, dict[str, tuple[Floats, Floats]]] = {}
    budget = Budget.of(file)
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            node, path = channel["target"].get("node"), channel["target"]["path"]
            if node not in wanted or path not in ("translation", "rotation", "scale"):
                continue
            sampler = animation["samplers"][channel["sampler"]]
            keys, values = (_accessor(document, buffer, sampler[key], budget) for key in ("input", "output"))
            if sampler.get("interpolation") == "CUBICSPLINE":
                values = values[1::3]  # between their tangents
            tracks.setdefault(node, {})[path] = keys[:, 0], values
    return tracks


def _accessor(document: Mapping[str, Any], buffer: bytes, index: int, budget: Budget) -> Floats:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    if accessor["componentType"] != 5126 or "sparse" in accessor or "byteStride" in view or not buffer:
        raise InputError("animation", expected="packed floats in a .glb", got="others")
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    budget.take(8 * accessor["count"] * width, "animation")
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    values = np.frombuffer(buffer, "<f4", accessor["count"] * width, start)
    return values.reshape(-1, width).astype(np.float64)


def _local(node: Mapping[str, Any], tracks: Mapping[str, tuple[Floats, Floats]], time: float) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rest = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    now = {path: np.array(node.get(path, value), np.float64) for path, value in rest.items()}
    for path, (keys, values) in tracks.items():
        last = int(np.clip(np.searchsorted(keys, time, side="right"), 1, max(len(keys) - 1, 1)))
        first = last - 1
        last = min(last, len(keys) - 1)
        share = 0.0 if first == last else np.clip((time - keys[first]) / (keys[last] - keys[first]), 0, 1)
        a, b = values[first], values[last]
        b = -b if path == "rotation" and a @ b < 0 else b
        now[path] = (1 - share) * a + share * b
    x, y, z, w = now["rotation"] / np.linalg.norm(now["rotation"])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = rotation * now["scale"], now["translation"]
    return local


def _of_usd(file: Path, name: str | None, size: tuple[int, int]) -> list[Camera]:
    from .usd_files import load_usd

    load_usd()
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(file))
    except Tf.ErrorException as error:
        raise InputError("USD file cannot be read", got=str(error).splitlines()[0]) from error
    found = {prim.GetName(): UsdGeom.Camera(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)}
    lens = found[_named(list(found), name)]
    z_up, unit = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z, UsdGeom.GetStageMetersPerUnit(stage)
    moves = lens.GetPrim().GetAttribute("focalLength").ValueMightBeTimeVarying() or any(
        UsdGeom.Xformable(prim).TransformMightBeTimeVarying()
        for prim in _ancestors(lens.GetPrim())
        if prim.IsA(UsdGeom.Xformable)
    )
    codes = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 0.5) if moves else [stage.GetStartTimeCode()]
    cameras = []
    for code in codes:
        now = lens.GetCamera(float(code))
        world = np.array(lens.ComputeLocalToWorldTransform(float(code)), np.float64).T  # row vectors there
        world[:3, 3] *= unit
        width, height = size
        fx = now.focalLength / now.horizontalAperture * width
        fy = now.focalLength / now.verticalAperture * height
        if abs(width / height - now.horizontalAperture / now.verticalAperture) > 1e-3 * width / height:
            fy = fx  # the frame's own aspect: the width is kept
        cx = width * (0.5 - now.horizontalApertureOffset / now.horizontalAperture)
        cy = height * (0.5 + now.verticalApertureOffset / now.verticalAperture)
        cameras.append(from_opengl(world, _intrinsics(fx, fy, cx, cy), size, z_up=z_up))
    return cameras


def _ancestors(prim: Any) -> list[Any]:
    prims = []
    while prim and not prim.IsPseudoRoot():
        prims.append(prim)
        prim = prim.GetParent()
    return prims


def _named(found: list[str], name: str | None) -> str:
    """``name``, or the only one of ``found``."""
    if name is None and len(found) == 1:
        return found[0]
    if name not in found:
        listed = ", ".join(found) or "no camera"
        raise InputError("--name", expected=f"one of {listed}", got=name or "none")
    return name
