"""Playing an avatar from Python: what ``rnd_runtime`` offers by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera as Camera
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.motion import load_motion as load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.shading.files.load import load_light as load_light
from rnd_runtime.shading.light import Light


def load_avatar(path: str | Path, *, threads: int | None = None) -> Avatar:
    """Read an ``avatar.onnx``. ``threads``: of onnxruntime; by default one per core of the process."""
    return Avatar.load(path, threads=threads)


def framing_camera(avatar: Avatar, motion: Motion, width: int, height: int) -> Camera:
    """A standing camera of ``width`` × ``height`` pixels, in front of the avatar, that shows all of ``motion``."""
    return front_path(frame_motion(avatar.skeleton, motion), CameraOptions(width, height))(0, 0.0)


def render(avatar: Avatar, motion: Motion, light: Light, camera: Camera, time: float = 0.0) -> NDArray[np.uint8]:
    """The avatar at ``time`` seconds of ``motion`` as 8-bit sRGB and alpha [H, W, 4], not premultiplied.

    Prepares the light anew each time: many frames are faster by one ``playback.frame.FrameRenderer``, on OpenGL too.
    """
    with FrameRenderer(avatar, light, camera) as renderer:
        return renderer.render(motion, time).srgb_alpha
