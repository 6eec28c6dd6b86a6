"""Cameras from files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.command import MAX_SIDE
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.playback.framing import CameraPath

Floats = NDArray[np.float64]


class _CameraRecord(msgspec.Struct, forbid_unknown_fields=True):
    """One camera, as in captures."""

    width: int
    height: int
    K: list[list[float]]
    world_to_camera: list[list[float]]

    def camera(self, file: Path) -> Camera:
        if max(self.width, self.height) > MAX_SIDE:
            got = f"{self.width} x {self.height}"
            raise InputError("camera size", expected=f"at most {MAX_SIDE} a side", got=got, file=file)
        try:
            return Camera(self.width, self.height, np.array(self.K), np.array(self.world_to_camera))
        except InputError as error:
            raise error.at(file=file) from error
        except ValueError as error:  # rows of different lengths
            raise InputError("camera matrices", expected="rows of one length", file=file) from error


class _CameraFile(msgspec.Struct):
    """A file with several cameras: a list with one for each frame, or a mapping of names."""

    cameras: list[_CameraRecord] | dict[str, _CameraRecord]


def file_path(text: str, size: tuple[int, int | None] | None, frames: range) -> CameraPath:
    """The camera path of ``FILE.json`` or ``FILE.json:NAME``.

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
    """``FILE.json:NAME`` or ``FILE.json`` as file and name."""
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
