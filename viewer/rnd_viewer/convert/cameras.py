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

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file, write_json
from rnd_runtime.motion.formats.gltf import MAX_FRAMES, GltfDocument, Tracks, local_parts, parents_of, tracks_of
from rnd_runtime.motion.motion import Z_UP_TO_Y_UP

Floats = NDArray[np.float64]

FLIP = np.diag([1.0, -1, -1, 1])
"""OpenGL's camera axes (Y up, looking along −Z) ↔ OpenCV's"""
_SUFFIXES = ".json (transforms.json), .gltf, .glb, .usd, .usda, .usdc or .usdz"
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
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
    gltf = GltfDocument(file)
    document, nodes = gltf.json, gltf.json.get("nodes", [])
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
    parents, chain = parents_of(nodes), [chosen]
    while parents[chain[-1]] >= 0:
        chain.append(parents[chain[-1]])
    tracks: Tracks = {}
    for animation in document.get("animations", []):
        tracks |= tracks_of(gltf, animation, chain)
    keys = np.concatenate([keys for keys, _, _ in tracks.values()] or [np.zeros(1)])
    frames = round(float(np.ptp(keys)) * fps) + 1
    if frames > MAX_FRAMES:
        raise InputError("animation of the camera", expected=f"at most {MAX_FRAMES} frames", got=frames)
    times = keys.min() + np.arange(frames) / fps
    world = np.tile(np.eye(4), (frames, 1, 1))
    for node in chain:  # from the camera up
        rotation, translation, scale = local_parts(nodes, node, tracks, times)
        local = np.tile(np.eye(4), (frames, 1, 1))
        local[:, :3, :3], local[:, :3, 3] = rotation * scale[..., None, :], translation
        world = local @ world
    return [from_opengl(matrix, K, size) for matrix in world]


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
