"""Where the picture is taken from: framed on the whole motion, on an orbit, or from a file.

A camera path is a function ``(frame, time_s) -> Camera`` of nothing but its arguments, so that any part of a
run can be rendered alone and gives the same pixels.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton

from .options import ELEVATION, FIELD_OF_VIEW, LARGEST_SIDE

Floats = NDArray[np.float64]
CameraPath = Callable[[int, float], Camera]

# Flesh, clothing and the crown reach this far from the nearest joint, as a part of the skeleton's height:
# 0.23 m for SMPL, whose head joint lies at the height of the ears.
PADDING = 0.14
ORBIT_SAMPLES = 72  # azimuths at which an orbit is checked to hold the body


@dataclass(frozen=True, eq=False)
class Framing:
    """What an automatic camera must show: every joint in every frame of a motion.

    Attributes:
        joints: [P, 3] m, world.
        centre: [3] m, the middle of their bounding box.
        padding: m that the body may reach beyond its joints.
        facing: rad, azimuth ``atan2(x, z)`` of the direction in which the body faces in the first frame.
    """

    joints: Floats
    centre: Floats
    padding: float
    facing: float

    @property
    def radius(self) -> float:
        """Radius in metres of a sphere about ``centre`` that holds the body at all times."""
        return float(np.linalg.norm(self.joints - self.centre, axis=1).max()) + self.padding


@dataclass(frozen=True)
class CameraOptions:
    """The options of an automatic camera; by default of the usual view.

    Attributes:
        width, height: pixels.
        fov_y: vertical field of view, rad.
        elevation: rad above the horizon.
        distance: m from the framing's centre; None takes the smallest that shows the whole motion.
    """

    width: int
    height: int
    fov_y: float = math.radians(FIELD_OF_VIEW)
    elevation: float = math.radians(ELEVATION)
    distance: float | None = None


def frame_motion(skeleton: Skeleton, motion: Motion) -> Framing:
    """The ``Framing`` of ``motion`` [F frames] played by ``skeleton``."""
    joints = np.concatenate(
        [
            skeleton.joint_transforms(rotations, translation)[:, :3, 3]
            for rotations, translation in zip(motion.rotations, motion.translations)
        ]
    )
    height = float(np.ptp(skeleton.rest_joints, axis=0).max())
    forward = motion.rotations[0, 0] @ np.array([0.0, 0.0, 1.0])  # a body at rest faces +Z
    facing = float(np.arctan2(forward[0], forward[2])) if np.hypot(forward[0], forward[2]) > 1e-3 else 0.0
    return Framing(joints, (joints.min(axis=0) + joints.max(axis=0)) / 2, PADDING * height, facing)


def front_path(framing: Framing, view: CameraOptions) -> CameraPath:
    """A standing camera that looks the body in the face as it is in the first frame."""
    distance = view.distance or _fitting_distance(framing, view, np.array([framing.facing]))
    camera = _camera_around(framing.centre, view, framing.facing, distance)
    return lambda frame, time_s: camera


def orbit_path(framing: Framing, view: CameraOptions, seconds: float) -> CameraPath:
    """A camera that starts in front and circles once in ``seconds``, towards the body's left."""
    azimuths = np.linspace(0, 2 * np.pi, ORBIT_SAMPLES, endpoint=False)
    distance = view.distance or _fitting_distance(framing, view, azimuths)
    return lambda frame, time_s: _camera_around(
        framing.centre, view, framing.facing + 2 * np.pi * time_s / seconds, distance
    )


def _camera_around(centre: Floats, view: CameraOptions, azimuth: float, distance: float) -> Camera:
    horizontal = np.cos(view.elevation)
    direction = np.array([horizontal * np.sin(azimuth), np.sin(view.elevation), horizontal * np.cos(azimuth)])
    return Camera.look_at(centre + distance * direction, centre, width=view.width, height=view.height, fov_y=view.fov_y)


def _fitting_distance(framing: Framing, view: CameraOptions, azimuths: Floats) -> float:
    """The smallest distance in metres at which every padded joint lies in the image at all ``azimuths``.

    A sphere of radius r at (x, y, z) from the centre, in camera axes, is inside the plane with half-angle a
    when d ≥ (|x| cos a + r) / sin a − z.
    """
    half_y = view.fov_y / 2
    half_x = np.arctan(np.tan(half_y) * view.width / view.height)
    distance = 0.0
    for azimuth in azimuths:
        rotation = _camera_around(framing.centre, view, azimuth, 1.0).world_to_camera[:3, :3]
        x, y, z = rotation @ (framing.joints - framing.centre).T
        for offset, half in ((x, half_x), (y, half_y)):
            needed = (np.abs(offset) * np.cos(half) + framing.padding) / np.sin(half) - z
            distance = max(distance, float(needed.max()))
    return distance


class _CameraRecord(msgspec.Struct, forbid_unknown_fields=True):
    """One camera as captures store it."""

    width: int
    height: int
    K: list[list[float]]
    world_to_camera: list[list[float]]

    def camera(self, file: Path) -> Camera:
        if max(self.width, self.height) > LARGEST_SIDE:
            got = f"{self.width} x {self.height}"
            raise InputError("camera size", expected=f"at most {LARGEST_SIDE} a side", got=got, file=file)
        try:
            return Camera(self.width, self.height, np.array(self.K), np.array(self.world_to_camera))
        except InputError as error:
            raise error.at(file=file) from error
        except ValueError as error:  # rows of different lengths
            raise InputError("camera matrices", expected="rows of one length", file=file) from error


class _CameraFile(msgspec.Struct):
    """A file with several cameras: a list holds one for each frame, a mapping names them."""

    cameras: list[_CameraRecord] | dict[str, _CameraRecord]


def file_path(text: str, size: tuple[int, int | None] | None, frames: range) -> CameraPath:
    """A camera path read from ``FILE.json`` or, for a camera with a name, ``FILE.json:NAME``.

    The file holds one camera ``{"width", "height", "K", "world_to_camera"}``, or ``{"cameras": [...]}`` with
    one for each frame, or ``{"cameras": {name: ...}}`` as ``capture.json`` has. ``size`` (width, height) in
    pixels resamples the view; without a height, the width is that of the longer side.

    Raises:
        InputError: for a file that holds no such cameras, or fewer than the ``frames`` that are asked for.
    """
    path, camera_name = split_camera(text)
    file = existing_file(path, what="camera file")
    cameras = _read_cameras(file, camera_name)
    if size is not None:
        cameras = [camera.resized(*_matching_size(camera, size)) for camera in cameras]

    if 1 < len(cameras) < frames.stop:
        raise InputError(
            "cameras", expected=f"one, or one for each of {frames.stop} frames", got=len(cameras), file=file
        )
    return lambda frame, time_s: cameras[frame if len(cameras) > 1 else 0]


def split_camera(text: str) -> tuple[Path, str]:
    """``FILE.json:NAME`` as file and name, which may be missing. Raises ``InputError`` for anything else."""
    match = re.fullmatch(r"(.+?\.json)(?::(.*))?", text)
    if match is None:
        raise InputError("--camera", expected="front, orbit (rnd-play), FILE.json or FILE.json:NAME", got=text)
    return Path(match[1]), match[2] or ""


def _read_cameras(file: Path, name: str) -> list[Camera]:
    data = file.read_bytes()
    try:
        document: dict[str, Any] = msgspec.json.decode(data, type=dict)
        records: list[_CameraRecord] | dict[str, _CameraRecord]
        if "cameras" in document:
            records = msgspec.json.decode(data, type=_CameraFile).cameras
        else:
            records = [msgspec.json.decode(data, type=_CameraRecord)]
        if isinstance(records, list):
            if name:
                raise InputError("camera", expected="FILE.json: its cameras have no names", got=name, file=file)
            chosen = records
        elif not name and len(records) == 1:
            chosen = list(records.values())
        elif name in records:
            chosen = [records[name]]
        else:
            expected = f"FILE.json:NAME with NAME one of {', '.join(records)}"
            raise InputError("camera", expected=expected, got=name or "no name", file=file)
        if not chosen:
            raise InputError("camera file holds no camera", file=file)
        return [record.camera(file) for record in chosen]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError("camera file cannot be read", got=str(error), file=file) from error


def _matching_size(camera: Camera, size: tuple[int, int | None]) -> tuple[int, int]:
    """``size`` for this camera: one number is the longer side, two must keep the camera's aspect."""
    width, height = size
    if height is None:
        scale = width / max(camera.width, camera.height)
        return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        expected = f"the camera's aspect, {camera.width}x{camera.height}"
        raise InputError("--size", expected=expected, got=f"{width}x{height}")
    return width, height
