"""Videos: what the landmark network sees of them, and of a capture's training frames beside the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.observations import Observations, load_observations, save_observations
from rnd_trainer.estimating.observing.camera_motion import steady
from rnd_trainer.estimating.observing.observe import Networks, observe
from rnd_trainer.importing.videos.video_file import VideoFile

from .filming import Window
from .motions import FPS


def observed(file: Path, kept: Path, every: int = 1) -> Observations:
    """What the networks see of every n-th frame of a steadied video; stored as .npz, and read from there again."""
    if not kept.exists():
        video, networks = VideoFile(file), Networks.open()
        numbers = list(video.numbers)[::every]
        people = [one.region for one in networks.detector(video.frame(numbers[0]))]
        save_observations(kept, observe(steady(video, numbers, people), networks, numbers=numbers))
    return load_observations(kept)


def window_of_capture(folder: Path, seen: Observations) -> Window:
    """The training frames of the capture in ``folder``.

    Args:
        seen: observations of a video of these frames, one for one.
    """
    capture = load_capture(folder)
    chosen = sorted(capture.split("train"), key=lambda frame: frame.frame)
    if len(chosen) <= seen.frames.max():
        raise InputError("observations", expected=f"of {len(chosen)} frames", got=int(seen.frames.max()) + 1)
    chosen = [chosen[k] for k in seen.frames]
    index = [frame.frame for frame in chosen]
    camera, motion, skeleton = capture.cameras[chosen[0].camera], capture.motion, capture.body.skeleton
    order = [skeleton.names.index(name) for name in JOINTS]
    bones = bone_transforms(skeleton, motion.rotations[index], motion.translations[index])
    to_camera = np.asarray(camera.world_to_camera, np.float64)
    moved = to_camera[:3, :3] @ bones[..., :3] @ skeleton.rest_joints[None, :, :, None]
    joints = moved[..., 0] + bones[..., 3] @ to_camera[:3, :3].T + to_camera[:3, 3]
    window: dict[str, NDArray[Any]] = {
        "rays": (seen.keypoints_px - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]],
        "confidence": seen.confidence,
        "hint_m": seen.keypoints_m,
        "rotations": (to_camera[:3, :3] @ bones[..., :3])[:, order],
        "joints": joints[:, order],
    }
    step = round(FPS / seen.fps)
    return {name: np.asarray(array, np.float32) for name, array in {**window, "step": np.array(step)}.items()}
