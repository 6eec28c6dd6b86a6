"""``capture.json`` (schema ``rnd-capture/1``) and the encodings of its images."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_header, read_image

Floats32 = NDArray[np.float32]
Split = Literal["train", "validation", "novel_view", "novel_pose", "relight"]
TRAIN_SHARE = 0.8
"""of the training camera's frames, without splits of their own; as in the paper"""

SCHEMA = "rnd-capture/1"
_Row3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]
_CHANNELS = {"image": 3, "mask": 1, "normal": 3, "normal_gt": 3, "albedo": 3, "albedo_estimate": 3}
_FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0}


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One image with its mask and others; paths are relative to the capture.

    A key we do not know is an error: a misspelt ``normals`` would quietly switch a loss off.
    """

    image: str  # sRGB, premultiplied on black
    mask: str  # coverage
    camera: str
    frame: Annotated[int, msgspec.Meta(ge=0)]  # index into the motion
    split: Split
    normal: str | None = None  # (n + 1) / 2 in the camera's OpenCV axes
    normal_gt: str | None = None
    albedo: str | None = None  # the truth, which only scores see: sRGB, premultiplied
    light: str | None = None  # None where it is unknown
    albedo_estimate: str | None = None  # as albedo, up to brightness and tint


class CaptureLight(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A light of a capture: the file's radiance times ``scale``, rotated by ``yaw`` rad; no file: it is unknown."""

    file: str | None = None
    scale: _Row3 = (1.0, 1.0, 1.0)
    yaw: float = 0.0


class CameraRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ``camera.Camera`` in JSON."""

    width: int
    height: int
    K: tuple[_Row3, _Row3, _Row3]
    world_to_camera: tuple[_Row4, _Row4, _Row4, _Row4]

    def camera(self) -> Camera:
        return Camera(self.width, self.height, np.array(self.K), np.array(self.world_to_camera))


class CaptureRecord(msgspec.Struct, frozen=True):  # further keys at the top inform people, not us
    """``capture.json``."""

    schema: str
    fps: Annotated[float, msgspec.Meta(gt=0)]
    cameras: dict[str, CameraRecord]
    body: str
    motion: str
    frames: Annotated[list[Frame], msgspec.Meta(min_length=1)]
    lights: dict[str, CaptureLight] = {}


def read_record(file: Path) -> CaptureRecord:
    """Decode ``capture.json``; every name in it is a path below its folder, every light and camera exists.

    Raises:
        InputError: naming the file and the field as a JSON path.
    """
    content = file.read_bytes()
    try:
        schema = msgspec.json.decode(content, type=dict[str, object]).get("schema")
        if schema != SCHEMA:
            raise InputError("schema", expected=SCHEMA, got=schema, file=file)
        record = msgspec.json.decode(content, type=CaptureRecord)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError("capture.json does not follow the format", got=str(error), file=file) from error
    for name in (record.body, record.motion):
        _inside(file, name)
    for name, light in record.lights.items():
        if light.file is not None:
            existing_file(_inside(file, light.file), what=f"light {name}")
        if min(light.scale) < 0:
            raise InputError(f"lights.{name}.scale", expected="not negative", got=light.scale, file=file)
    for frame in record.frames:
        _check_known("camera", frame.camera, record.cameras, frame, file)
        if frame.light is not None:
            _check_known("light", frame.light, record.lights, frame, file)
    return record


def check_images(frame: Frame, camera: Camera, file: Path) -> None:
    """Check the headers of a frame's images against its camera and the format."""
    for kind, channels in _CHANNELS.items():
        name = getattr(frame, kind)
        if name is None:
            continue
        image = _inside(file, name)
        try:
            header = read_header(image)
        except InputError as error:
            raise error.at(frame=frame.frame) from error
        size, wanted = f"{header.width} x {header.height}", f"{camera.width} x {camera.height}"
        count, names = len(header.channels), "".join(header.channels)
        checks = (
            ("size", size == wanted, f"{wanted} as camera {frame.camera}", size),
            ("channels", count == channels, f"{channels}, no alpha", f"{count} ({names})"),
            ("pixels", header.pixel_type in _FULL_SCALE, "8 or 16 bit", header.pixel_type),
        )
        for what, fits, expected, got in checks:
            if not fits:
                raise InputError(f"{what} of {kind}", expected=expected, got=got, file=image, frame=frame.frame)


def read_unit_range(path: Path) -> Floats32:
    """An 8- or 16-bit image [H, W, C] as floats in [0, 1]."""
    pixels = read_image(path)
    return pixels.astype(np.float32) / np.float32(_FULL_SCALE[pixels.dtype.name])


def decode_normals(encoded: Floats32) -> Floats32:
    """Unit normals [H, W, 3] of (n + 1) / 2.

    Black or mid-grey pixels, which writers leave where there is no surface, become zero.
    """
    normals = 2 * encoded - 1
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (encoded > 0).any(-1, keepdims=True) & (length > 0.1)
    return np.where(known, normals / np.where(known, length, 1), 0).astype(np.float32)


def _check_known(what: str, name: str, known: Collection[str], frame: Frame, file: Path) -> None:
    if name not in known:
        expected = " or ".join(known) or "none, as the capture lists none"
        raise InputError(what, expected=expected, got=name, file=file, frame=frame.frame)


def _inside(file: Path, name: str) -> Path:
    """The path called ``name`` in ``file``, if it is relative and stays below the folder of ``file``."""
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise InputError("path", expected="a relative path inside the capture", got=repr(name), file=file)
    return file.parent / path
