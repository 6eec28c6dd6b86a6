"""Images of a report: a turntable clip, a pose under rotated and other lights, materials, seldom seen surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.playback.aov import aov_image
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.framing import FIELD_OF_VIEW, CameraOptions, frame_motion, front_path, orbit_path
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, Up, light_notes
from rnd_viewer.play.video import clip_writer

Bytes = NDArray[np.uint8]
SIDE, FPS, SECONDS = 448, 24, 5.0
YAWS = (0, 90, 180, 270)  # degrees: the learned light from four sides
AOVS = ("albedo", "normal", "roughness", "visibility")
MODE = "table+sun"
CLOSE_UPS = {
    "back of the head": ("head", (0, 0.1, 0), (0, 0.1, -1)),
    "under the chin": ("head", (0, 0.05, 0), (0, -0.8, 1)),
    "left palm": ("left_wrist", (0.08, 0, 0), (0, -1, 0.3)),
    "right palm": ("right_wrist", (-0.08, 0, 0), (0, -1, 0.3)),
    "left sole": ("left_ankle", (0, -0.05, 0.05), (0, -1, 0.3)),
    "right sole": ("right_ankle", (0, -0.05, 0.05), (0, -1, 0.3)),
}
"""surfaces that a video seldom shows: a joint in the rest pose, the offset from it in m, the direction to the camera"""
CLOSE_UP_SIDE = 224  # pixels
CLOSE_UP_DISTANCE, HAND_DISTANCE = 0.65, 0.4  # m


class AvatarRenders:
    """An avatar in one motion, the rest pose by default.

    Attributes:
        notes: on the motion, and on every light that was read.
    """

    def __init__(self, avatar_file: Path, read_motion: Callable[[Skeleton], Motion] | None) -> None:
        self.avatar = Avatar.load(avatar_file)
        skeleton = self.avatar.skeleton
        self.motion = _rest_pose(skeleton) if read_motion is None else read_motion(skeleton)
        self.notes = list(self.motion.notes)
        view = CameraOptions(SIDE, SIDE)
        framing = frame_motion(skeleton, self.motion)
        self._orbit = orbit_path(framing, view, SECONDS)
        self._front = front_path(framing, view)
        self._learned = Light(self.avatar.trained_light)

    def turntable(self) -> bytes:
        """An mp4 of one orbit while the motion plays, under the learned light. Needs PyAV (else InputError)."""
        with temporary_folder() as folder, self._renderer(MODE) as renderer:
            path = folder / "turntable.mp4"
            with clip_writer(path, fps=FPS) as append:
                for number in range(round(SECONDS * FPS)):
                    time_s = number / FPS
                    append(renderer.render(self.motion, time_s, self._orbit(number, time_s)).srgb)
            return path.read_bytes()

    def relights(self, hdrs: tuple[Path, ...], up: Up) -> Iterator[tuple[str, Bytes]]:
        """Captions and images of the motion's middle: the learned light rotated, then each of ``hdrs``.

        ``up``: the axis that points up in their files.
        """
        lights = [(f"learned light, {yaw}°", self._learned.with_yaw(math.radians(yaw))) for yaw in YAWS]
        lights += [(hdr.stem, self._read_light(hdr, up)) for hdr in hdrs]
        time_s = self.motion.duration / 2
        camera = self._front(0, time_s)
        with self._renderer(MODE) as renderer:
            for caption, light in lights:
                renderer.relight(light)
                yield caption, renderer.render(self.motion, time_s, camera).srgb

    def _renderer(self, shade: str) -> FrameRenderer:
        return FrameRenderer(self.avatar, self._learned, shade=shade, raster="auto")

    def _read_light(self, hdr: Path, up: Up) -> Light:
        light = load_light(hdr, up=up)
        self.notes += [f"{hdr.name}: {note}" for note in light_notes(light)]
        return light

    def materials(self) -> Iterator[tuple[str, Bytes]]:
        """Captions and images of albedo, normals, roughness and visibility."""
        time_s = self.motion.duration / 2
        with self._renderer("ao") as renderer:
            frame = renderer.render(self.motion, time_s, self._front(0, time_s), aovs=AOVS)
        for name, values in frame.aovs.items():
            image = aov_image(name, values, frame.alpha)
            yield name, np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))

    def close_ups(self) -> Iterator[tuple[str, Bytes]]:
        """Captions and images of the albedo of ``CLOSE_UPS`` in the rest pose, of the joints that the skeleton has."""
        skeleton = self.avatar.skeleton
        at_rest = _rest_pose(skeleton)
        fov = math.radians(FIELD_OF_VIEW)
        with self._renderer("ao") as renderer:
            for caption, (joint, offset, direction) in CLOSE_UPS.items():
                if joint not in skeleton.names:
                    continue
                target = skeleton.rest_joints[skeleton.names.index(joint)] + offset
                distance = HAND_DISTANCE if joint.endswith("wrist") else CLOSE_UP_DISTANCE
                eye = target + distance * np.array(direction) / np.linalg.norm(direction)
                camera = Camera.look_at(eye, target, width=CLOSE_UP_SIDE, height=CLOSE_UP_SIDE, fov_y=fov)
                frame = renderer.render(at_rest, 0.0, camera, aovs=("albedo",))
                yield caption, np.ascontiguousarray(aov_image("albedo", frame.aovs["albedo"], frame.alpha))


def _rest_pose(skeleton: Skeleton) -> Motion:
    return Motion(np.tile(np.eye(3), (1, len(skeleton), 1, 1)), np.zeros((1, 3)), FPS, skeleton.names)
