"""Videos: what the landmark network sees of them, and of a capture's training frames beside the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.observations import HAND_POINTS, Masks, Observations, load_observations, save_observations
from rnd_trainer.estimating.observing.detection import Detector
from rnd_trainer.estimating.observing.landmarks import LandmarkNetwork
from rnd_trainer.estimating.observing.networks import open_network
from rnd_trainer.estimating.observing.sides import merge_views
from rnd_trainer.estimating.observing.tracking import find_person, follow
from rnd_trainer.importing.videos.video_file import VideoFile

from .errors import Window

FRAMES = 12
"""of a window"""


def observed(file: Path, kept: Path, every: int = 1) -> Observations:
    """What the landmark network sees of every n-th frame of a video; stored as .npz, and read from there again."""
    if not kept.exists():
        detector = Detector(open_network("person_detector", 1))
        network = LandmarkNetwork(open_network("pose_landmarks", 1))
        video = VideoFile(file)
        numbers = list(video.numbers)[::every]
        start = find_person(video, numbers, detector, network)
        seen = [(n, views) for n, views in follow(video, numbers, start, detector, network) if views is not None]
        frames, found = np.array([n for n, _ in seen]), [views for _, views in seen]
        merged = merge_views(
            np.stack([views.points for views in found]),
            np.stack([views.metres for views in found]),
            np.stack([views.confidence for views in found]),
            np.array([views.region.size for views in found]),
            frames / video.fps,
        )
        size = video.width, video.height
        observations = Observations(
            video.fps,
            size,
            frames,
            merged.points.astype(np.float32),
            merged.confidence.astype(np.float32),
            merged.spread.astype(np.float32),
            merged.metres.astype(np.float32),
            np.full((len(frames), 2, HAND_POINTS, 2), np.nan, np.float32),
            np.zeros((len(frames), 2), np.float32),
            Masks.of((np.uint8(255 * views.mask + 0.5) for views in found), size),
        )
        save_observations(kept, observations)
    return load_observations(kept)


def windows_of_capture(folder: Path, seen: Observations, frames: int | None = FRAMES) -> list[Window]:
    """Windows of the training frames of the capture in ``folder``.

    Args:
        seen: observations of a video of these frames, one for one.
        frames: of a window; all in one where None.
    """
    capture = load_capture(folder)
    chosen = sorted(capture.split("train"), key=lambda frame: frame.frame)
    if len(chosen) <= seen.frames.max():
        raise InputError(
            "observations", expected=f"of {len(chosen)} frames", got=int(seen.frames.max()) + 1, file=observed
        )
    chosen = [chosen[k] for k in seen.frames]
    index = [frame.frame for frame in chosen]
    camera, motion, skeleton = capture.cameras[chosen[0].camera], capture.motion, capture.body.skeleton
    order = [skeleton.names.index(name) for name in JOINTS]
    bones = bone_transforms(skeleton, motion.rotations[index], motion.translations[index])
    to_camera = np.asarray(camera.world_to_camera, np.float64)
    moved = to_camera[:3, :3] @ bones[..., :3] @ skeleton.rest_joints[None, :, :, None]
    joints = moved[..., 0] + bones[..., 3] @ to_camera[:3, :3].T + to_camera[:3, 3]
    window = {
        "rays": (seen.keypoints_px - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]],
        "confidence": seen.confidence,
        "hint_m": seen.keypoints_m,
        "rotations": (to_camera[:3, :3] @ bones[..., :3])[:, order],
        "joints": joints[:, order],
    }
    parts = np.array_split(np.arange(len(index)), max(1, round(len(index) / frames)) if frames else 1)
    return [{name: np.asarray(array[part], np.float32) for name, array in window.items()} for part in parts]
