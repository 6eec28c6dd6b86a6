"""Captures: a directory of images, masks, normals, cameras, a body and its motion (DESIGN.md section 8)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from . import light as light_files
from .body import Body as Body
from .camera import Camera
from .errors import InputError
from .files import atomic_path, existing_file
from .images import read_header, read_image
from .light import Light
from .motion import Motion, load_motion, save_motion

Floats32 = NDArray[np.float32]
Split = Literal["train", "novel_view", "novel_pose", "relight"]

SCHEMA = "rnd-capture/1"
_Row3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One picture; paths are relative to the capture.

    A key we do not know is an error: a misspelt ``normals`` would quietly switch a loss off.
    """

    image: str  # 8-bit sRGB, premultiplied on black
    mask: str  # coverage
    camera: str
    frame: Annotated[int, msgspec.Meta(ge=0)]  # index into the motion
    split: Split
    normal: str | None = None  # (n + 1) / 2 in the camera's OpenCV axes
    normal_gt: str | None = None
    albedo: str | None = None  # sRGB, premultiplied
    light: str | None = None  # None where nobody measured it


class CaptureLight(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A light of a capture: the file's radiance times ``scale``, turned by ``yaw`` rad."""

    file: str
    scale: _Row3 = (1.0, 1.0, 1.0)
    yaw: float = 0.0


class _CameraRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    width: int
    height: int
    K: tuple[_Row3, _Row3, _Row3]
    world_to_camera: tuple[_Row4, _Row4, _Row4, _Row4]


class _CaptureRecord(msgspec.Struct, frozen=True):  # further keys at the top inform people, not us
    schema: str
    fps: Annotated[float, msgspec.Meta(gt=0)]
    cameras: dict[str, _CameraRecord]
    body: str
    motion: str
    frames: list[Frame]
    lights: dict[str, CaptureLight] = {}


@dataclass(frozen=True, eq=False)
class FrameImages:
    """The pictures of one frame, all [H, W, …] float32 in [0, 1] unless said otherwise.

    Attributes:
        image_srgb: [H, W, 3] sRGB, premultiplied on black.
        mask: [H, W] coverage.
        normal, normal_gt: [H, W, 3] unit, camera's OpenCV axes (visible means z < 0); zero where there is no
            data. None where the capture has none.
        albedo_srgb: [H, W, 3] sRGB of the base colour, premultiplied; None where the capture has none.
    """

    image_srgb: Floats32
    mask: Floats32
    normal: Floats32 | None
    normal_gt: Floats32 | None
    albedo_srgb: Floats32 | None


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture whose files have been checked against each other; pictures are read on demand.

    Attributes:
        folder: what all paths are relative to.
        cameras, lights: by name.
        body: the template.
        motion: poses of ``body.skeleton``; ``Frame.frame`` indexes it.
        frames: every picture, in file order.
    """

    folder: Path
    cameras: dict[str, Camera]
    lights: dict[str, CaptureLight]
    body: Body
    motion: Motion
    frames: tuple[Frame, ...]

    @property
    def fps(self) -> float:
        return self.motion.fps

    def split(self, name: Split) -> list[Frame]:
        """The frames of one split, in file order."""
        return [frame for frame in self.frames if frame.split == name]

    def load_frame(self, frame: Frame) -> FrameImages:
        """Read and decode the pictures of ``frame``."""
        optional = {
            kind: None if (name := getattr(frame, kind)) is None else _unit_range(self.folder / name)
            for kind in ("normal", "normal_gt", "albedo")
        }
        return FrameImages(
            image_srgb=_unit_range(self.folder / frame.image),
            mask=_unit_range(self.folder / frame.mask)[..., 0],
            normal=_decode_normals(optional["normal"]),
            normal_gt=_decode_normals(optional["normal_gt"]),
            albedo_srgb=optional["albedo"],
        )

    def load_light(self, name: str) -> Light:
        """The light called ``name``, scaled and turned as the capture says."""
        if name not in self.lights:
            raise InputError("light", expected=" or ".join(self.lights) or "none", got=name, file=self.folder)
        entry = self.lights[name]
        return light_files.load_light(self.folder / entry.file, yaw=entry.yaw).scaled(entry.scale)


def load_capture(path: str | Path, *, motion_file: str | None = None) -> Capture:
    """Read a capture and check everything that can be checked without decoding pictures.

    Args:
        path: the directory, or its ``capture.json``.
        motion_file: another motion in place of the one named there, relative to the directory.

    Raises:
        InputError: naming file, field or frame, and both values.
    """
    path = Path(path)
    file = existing_file(path / "capture.json" if path.is_dir() else path, what="capture")
    folder = file.parent
    record = _decode(file)
    for name in (record.body, record.motion, *(light.file for light in record.lights.values())):
        existing_file(folder / _inside(name, file), what="file of the capture")
    for name, light in record.lights.items():
        if min(light.scale) < 0:
            raise InputError(f"lights.{name}.scale", expected="not negative", got=light.scale, file=file)
    cameras = {name: _camera(name, camera, file) for name, camera in record.cameras.items()}
    body = Body.load(folder / record.body)
    motion = load_motion(
        folder / (motion_file or record.motion), body.skeleton, joint_names=body.skeleton.names
    )
    if abs(motion.fps - record.fps) > 1e-3:
        raise InputError(
            "fps of the motion",
            expected=f"{record.fps:g} as in capture.json",
            got=f"{motion.fps:g}",
            file=motion.source,
            hint="; ".join(motion.notes) or None,
        )
    if not record.frames:
        raise InputError("frames", expected="at least one", got="none", file=file)
    for frame in record.frames:
        _check_frame(frame, folder, cameras, record.lights, motion.frame_count, file)
    return Capture(folder, cameras, dict(record.lights), body, motion, tuple(record.frames))


def save_capture(capture: Capture, **information: object) -> None:
    """Write ``capture.json``, ``body.npz`` and ``motion.npz`` of ``capture`` into its folder.

    Pictures and lights are the caller's to write. ``information`` (a subject, a renderer) is kept for people.
    """
    capture.body.save(capture.folder / "body.npz")
    save_motion(capture.folder / "motion.npz", capture.motion)
    cameras = {
        name: {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "world_to_camera": camera.world_to_camera.tolist(),
        }
        for name, camera in capture.cameras.items()
    }
    record = {
        "schema": SCHEMA,
        **information,
        "fps": capture.fps,
        "cameras": cameras,
        "lights": capture.lights,
        "body": "body.npz",
        "motion": "motion.npz",
        "frames": capture.frames,
    }
    with atomic_path(capture.folder / "capture.json") as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")


def _decode(file: Path) -> _CaptureRecord:
    content = file.read_bytes()
    try:
        schema = msgspec.json.decode(content, type=dict[str, msgspec.Raw]).get("schema", msgspec.Raw(b"null"))
        if msgspec.json.decode(schema) != SCHEMA:
            raise InputError("schema", expected=SCHEMA, got=msgspec.json.decode(schema), file=file)
        return msgspec.json.decode(content, type=_CaptureRecord)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise InputError("capture.json does not follow the format", got=str(error), file=file) from error


def _inside(name: str, file: Path) -> str:
    """``name`` if it is a relative path that stays below the capture."""
    path = PurePosixPath(name)
    if not name or path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise InputError(
            "path in the capture", expected="a relative path inside its folder", got=name, file=file
        )
    return name


def _camera(name: str, record: _CameraRecord, file: Path) -> Camera:
    try:
        return Camera(record.width, record.height, np.array(record.K), np.array(record.world_to_camera))
    except InputError as error:
        what = f"cameras.{name}: {error.what}"
        raise InputError(what, expected=error.expected, got=error.got, file=file) from error


_CHANNELS = {"image": 3, "mask": 1, "normal": 3, "normal_gt": 3, "albedo": 3}


def _check_frame(
    frame: Frame,
    folder: Path,
    cameras: Mapping[str, Camera],
    lights: Mapping[str, CaptureLight],
    frame_count: int,
    file: Path,
) -> None:
    if frame.camera not in cameras:
        raise InputError(
            "camera", expected=" or ".join(cameras), got=frame.camera, file=file, frame=frame.frame
        )
    if frame.light is not None and frame.light not in lights:
        raise InputError("light", expected=" or ".join(lights), got=frame.light, file=file, frame=frame.frame)
    if frame.frame >= frame_count:
        raise InputError(
            "frame",
            expected=f"an index into the motion's {frame_count} frames",
            got=frame.frame,
            file=file,
            frame=frame.frame,
        )
    camera = cameras[frame.camera]
    for kind, channels in _CHANNELS.items():
        name = getattr(frame, kind)
        if name is None:
            continue
        picture = folder / _inside(name, file)
        if not picture.is_file():
            raise InputError(f"{kind} not found", file=picture, frame=frame.frame)
        header = read_header(picture)
        if (header.width, header.height) != (camera.width, camera.height):
            raise InputError(
                f"size of {kind}",
                expected=f"{camera.width} x {camera.height} as camera {frame.camera}",
                got=f"{header.width} x {header.height}",
                file=picture,
                frame=frame.frame,
            )
        if len(header.channels) != channels:
            raise InputError(
                f"channels of {kind}",
                expected=f"{channels}, without alpha",
                got=f"{len(header.channels)} ({', '.join(header.channels)})",
                file=picture,
                frame=frame.frame,
            )
        if header.pixel_type not in _FULL_SCALE:
            raise InputError(
                f"pixels of {kind}",
                expected="8 or 16 bit",
                got=header.pixel_type,
                file=picture,
                frame=frame.frame,
            )


_FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0}


def _unit_range(path: Path) -> Floats32:
    """An 8- or 16-bit picture [H, W, C] as floats in [0, 1]."""
    pixels = read_image(path)
    return pixels.astype(np.float32) / np.float32(_FULL_SCALE[pixels.dtype.name])


def _decode_normals(encoded: Floats32 | None) -> Floats32 | None:
    """Unit normals of (n + 1) / 2; black or mid-grey pixels are what writers leave where there is none."""
    if encoded is None:
        return None
    normals = 2 * encoded - 1
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (encoded > 0).any(-1, keepdims=True) & (length > 0.1)
    return np.where(known, normals / np.where(known, length, 1), 0).astype(np.float32)
