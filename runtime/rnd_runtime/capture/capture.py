"""Captures: a directory of images, masks, normals, cameras, a body and its motion."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path, existing_file, is_folder, sha256_of
from rnd_runtime.core.kinds import explained
from rnd_runtime.motion.motion import Motion, load_motion, save_motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light

from .body import Body as Body
from .format import SCHEMA, check_images, decode_normals, read_record, read_unit_range
from .format import CaptureLight as CaptureLight
from .format import Frame as Frame
from .format import Split as Split

Floats32 = NDArray[np.float32]
VALIDATION_EVERY = 5
"""training frames per frame of the validation split"""


@dataclass(frozen=True, eq=False)
class FrameImages:
    """The images of one frame, [H, W, …] float32 in [0, 1].

    Attributes:
        image_srgb: [H, W, 3] sRGB, premultiplied on black.
        mask: [H, W] coverage.
        normal, normal_gt: [H, W, 3] unit, camera's OpenCV axes (visible means z < 0); zero where there is no
            data. None where the capture has none.
        albedo_srgb, albedo_estimate_srgb: [H, W, 3] sRGB of the base colour, true and estimated, premultiplied; None
            where the capture has none.
    """

    image_srgb: Floats32
    mask: Floats32
    normal: Floats32 | None
    normal_gt: Floats32 | None
    albedo_srgb: Floats32 | None
    albedo_estimate_srgb: Floats32 | None


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture whose files have been checked against each other; images are read on demand.

    Attributes:
        folder: what all paths are relative to.
        cameras, lights: by name.
        body: the template.
        motion: poses of ``body.skeleton``; ``Frame.frame`` indexes it.
        frames: of all images, in file order.
        name: of the file in ``folder`` that it was read from.
    """

    folder: Path
    cameras: dict[str, Camera]
    lights: dict[str, CaptureLight]
    body: Body
    motion: Motion
    frames: tuple[Frame, ...]
    name: str = "capture.json"

    @property
    def file(self) -> Path:
        """What it was read from; of a capture that was made, what ``save_capture`` writes."""
        return self.folder / self.name

    @property
    def fps(self) -> float:
        return self.motion.fps

    def motion_for(self, skeleton: Skeleton) -> Motion:
        """Its motion for an avatar of ``skeleton``, which may not be the one it was captured with.

        The root is where the images show it, whatever the rest positions.
        """
        motion, own = self.motion, self.body.skeleton
        if motion.joint_names != skeleton.names:
            motion = load_motion(motion.source, skeleton, joint_names=own.names)
        shift = own.rest_joints[0] - skeleton.rest_joints[0]
        return replace(motion, translations=self.motion.translations + shift)

    def split(self, name: Split) -> list[Frame]:
        """The frames of one split, in file order."""
        return [frame for frame in self.frames if frame.split == name]

    def holding_out(self) -> Capture:
        """This capture with every ``VALIDATION_EVERY``-th training frame moved to the split ``validation``."""
        held_out = set(map(id, self.split("train")[VALIDATION_EVERY // 2 :: VALIDATION_EVERY]))
        frames = (msgspec.structs.replace(f, split="validation") if id(f) in held_out else f for f in self.frames)
        return replace(self, frames=tuple(frames))

    def load_frame(self, frame: Frame) -> FrameImages:
        """Read and decode the images of ``frame``."""

        def read(name: str | None) -> Floats32 | None:
            return None if name is None else read_unit_range(self.folder / name)

        try:
            mask = read_unit_range(self.folder / frame.mask)[..., 0]
            return FrameImages(
                image_srgb=read_unit_range(self.folder / frame.image),
                mask=mask,
                normal=self._read_normals(frame.normal, mask),
                normal_gt=self._read_normals(frame.normal_gt, mask),
                albedo_srgb=read(frame.albedo),
                albedo_estimate_srgb=read(frame.albedo_estimate),
            )
        except InputError as error:
            raise error.at(frame=frame.frame) from error

    def _read_normals(self, name: str | None, mask: Floats32) -> Floats32 | None:
        """Unit normals [H, W, 3], refused where their mean points away from the camera."""
        if name is None:
            return None
        normals = decode_normals(read_unit_range(self.folder / name))
        depths = normals[mask > 0.5][:, 2]
        if depths.size and depths.mean() > 0:
            raise InputError(
                "normals point away from the camera",
                expected="z < 0 in the camera's OpenCV axes where a surface is visible",
                got=f"a mean of {depths.mean():.2f}",
                file=self.folder / name,
                hint="OpenGL's have y and z the other way round",
            )
        return normals

    def light_sha256(self, name: str) -> str | None:
        """Of the map of a light, its scale and yaw; None without such a map."""
        entry = self.lights.get(name)
        if entry is None or entry.file is None or not (self.folder / entry.file).is_file():
            return None
        content = f"{sha256_of(self.folder / entry.file)} {entry.scale} {entry.yaw}"
        return hashlib.sha256(content.encode()).hexdigest()

    def has_map(self, light: str | None) -> bool:
        """Whether the map of ``light`` is known."""
        return light is not None and light in self.lights and self.lights[light].file is not None

    def load_light(self, name: str) -> Light:
        """The light called ``name``, with its scale and yaw."""
        if name not in self.lights:
            known = " or ".join(self.lights) or "none, as the capture lists none"
            raise InputError("light", expected=known, got=name, file=self.folder)
        entry = self.lights[name]
        if entry.file is None:
            raise InputError("light", expected="one with a map", got=name, file=self.file)
        return load_light(self.folder / entry.file, yaw=entry.yaw).scaled(entry.scale)


def capture_file(path: str | Path) -> Path:
    """The ``capture.json`` of a folder, or ``path`` itself where it is none."""
    return Path(path) / "capture.json" if is_folder(path) else Path(path)


def load_capture(path: str | Path, *, motion_file: str | None = None) -> Capture:
    """Read a capture and check everything that can be checked without decoding images.

    Args:
        path: the directory, or its ``capture.json``.
        motion_file: another motion instead of its own, relative to the directory.

    Raises:
        InputError: naming file, field or frame, and both values.
    """
    try:
        file = existing_file(capture_file(path), what="capture")
        record = read_record(file)
    except InputError as error:
        raise explained(error, path, "capture") from error
    folder = file.parent
    cameras = {}
    for name, camera in record.cameras.items():
        try:
            cameras[name] = camera.camera()
        except InputError as error:
            raise error.at(file=f"{file}: cameras.{name}") from error
    body = Body.load(folder / record.body)
    names = body.skeleton.names
    motion = load_motion(folder / (motion_file or record.motion), body.skeleton, joint_names=names)
    if abs(motion.fps - record.fps) > 1e-3:
        raise InputError(
            "fps of the motion",
            expected=f"{record.fps:g} as in capture.json",
            got=f"{motion.fps:g}",
            file=motion.source,
            hint="; ".join(motion.notes) or None,
        )
    for frame in record.frames:
        if frame.frame >= motion.frame_count:
            expected = f"an index below the {motion.frame_count} frames of {motion.source}"
            raise InputError("frame", expected=expected, got=frame.frame, file=file, frame=frame.frame)
        check_images(frame, cameras[frame.camera], file)
    return Capture(folder, cameras, record.lights, body, motion, tuple(record.frames), file.name)


def save_capture(capture: Capture, **information: object) -> None:
    """Write ``capture.json``, ``body.npz`` and ``motion.npz`` of ``capture`` into its folder.

    Images and lights are the caller's to write. ``information`` (a subject, a renderer) is kept for people.
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
