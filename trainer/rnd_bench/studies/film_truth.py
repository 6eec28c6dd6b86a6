"""What a video does not show: exact poses, other cameras of the same instants, another estimator's errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from rnd_bench.lifter.pose2sim import SCORED, Calibrated, watched
from rnd_runtime.capture.capture import Capture, Frame, load_capture, save_capture
from rnd_runtime.capture.format import Split
from rnd_runtime.core.arrays import spaced_indices
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_runtime.motion.motion import Motion
from rnd_stage.film.estimates import estimated_motion
from rnd_trainer.estimating.observations import Observations
from rnd_trainer.importing.images import undistort_image
from rnd_trainer.importing.videos.video_file import VideoFile
from rnd_trainer.importing.write import premultiplied

from .video import LIMBS, pa_mm

Floats = NDArray[np.float64]

HIPS = ("left_hip", "right_hip")
INSTANTS = 5
"""scored by each camera"""
WHAM_PA_MM = 35.9
"""WHAM's error on 3DPW. Source: Shin et al. 2023 (arXiv 2312.07531), table 1"""
WHAM_SECONDS = 0.1
"""makes its errors as smooth: accelerations of real videos are then 6.6 m/s² off, as in that table"""


# -- a rendered person -------------------------------------------------------------------------------------


def in_capture_of(truth: Capture, imported: Capture, splits: Sequence[Split]) -> Capture:
    """``truth``'s frames of ``splits``, exact poses and cameras in the world of ``imported``, light unknown.

    ``imported`` is of a video of ``truth``'s training frames, of the same body.
    """
    to_truth = _to_truth(truth, imported)
    chosen = sorted((f for f in truth.frames if f.split in splits), key=lambda f: (f.split, f.camera, f.frame))
    return replace(
        truth,
        cameras={name: camera.in_frame(to_truth) for name, camera in truth.cameras.items()},
        motion=_moved(truth, to_truth),
        frames=tuple(msgspec.structs.replace(frame, light=None) for frame in chosen),
    )


def exact_poses(truth: Capture, imported: Capture) -> Capture:
    """``imported`` in the exact poses of ``truth``."""
    filmed = sorted(truth.split("train"), key=lambda frame: frame.frame)
    _check_whole(imported, len(filmed))
    frames = (msgspec.structs.replace(f, frame=filmed[f.frame].frame) for f in imported.frames)
    return replace(imported, motion=_moved(truth, _to_truth(truth, imported)), frames=tuple(frames))


def _check_whole(imported: Capture, count: int) -> None:
    """Refuse a capture that does not begin with the first frame of its video and end with the last of ``count``."""
    got = imported.motion.frame_count
    if got != count:
        raise InputError("video", expected=f"the person in all {count} frames", got=got, file=imported.folder)


def _to_truth(truth: Capture, imported: Capture) -> Floats:
    """[4, 4] m, from the world of ``imported`` to that of ``truth``: its camera stood where the training camera is."""
    camera = truth.cameras[truth.split("train")[0].camera]
    (own,) = imported.cameras.values()
    return np.asarray(np.linalg.inv(camera.world_to_camera) @ own.world_to_camera)


def _moved(truth: Capture, to_truth: Floats) -> Motion:
    """``truth``'s motion in the world from which ``to_truth`` leads."""
    motion, root = truth.motion, truth.body.skeleton.rest_joints[0]
    back = np.linalg.inv(to_truth)
    rotations = motion.rotations.copy()
    rotations[:, 0] = back[:3, :3] @ rotations[:, 0]
    return replace(
        motion, rotations=rotations, translations=(root + motion.translations) @ back[:3, :3].T + back[:3, 3] - root
    )


# -- another estimator's errors ----------------------------------------------------------------------------


def wham_like(capture: Capture) -> Capture:
    """``capture`` in poses with noise as large and as smooth as WHAM's errors added."""
    skeleton = capture.body.skeleton
    chosen = [skeleton.names.index(name) for name in LIMBS]

    def limbs(motion: Motion) -> Floats:
        return skeleton.joint_transforms(motion.rotations, motion.translations)[:, chosen][..., :3, 3]

    def noisy(strength: float) -> Motion:
        return estimated_motion(capture.motion, 0, strength, jitter=0, seconds=WHAM_SECONDS)

    given = limbs(capture.motion)
    strength = brentq(lambda strength: pa_mm(limbs(noisy(strength)), given) - WHAM_PA_MM, 0, 10, rtol=1e-3)
    return replace(capture, motion=noisy(strength))


# -- real cameras ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Filmed:
    """One of Pose2Sim's cameras, with what the three others saw.

    Attributes:
        seen: by camera, at the same frames.
        hips: [T, 3] m, triangulated, in the file's world; NaN where they are unknown.
    """

    name: str
    folder: Path
    cameras: dict[str, Calibrated]
    seen: dict[str, Observations]
    hips: Floats

    @property
    def video(self) -> Path:
        return self._video(self.name)

    @property
    def intrinsics(self) -> tuple[float, ...]:
        K = self.cameras[self.name].intrinsics
        return tuple(map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))

    @property
    def distortion(self) -> tuple[float, ...]:
        return tuple(map(float, self.cameras[self.name].distortion))

    def _video(self, name: str) -> Path:
        return self.folder / "videos" / f"{name}.mp4"

    def scored(self, imported: Capture, out: Path) -> Capture:
        """A capture in ``out`` of ``imported``'s person as the other cameras saw him, in ``imported``'s motion.

        One camera does not show how large its world is: the others stand at their calibrated places times the ratio of
        the hips' estimated depths to the triangulated ones.
        """
        if (out / "capture.json").exists():
            return load_capture(out)
        (own,), here = imported.cameras.values(), self.cameras[self.name]
        _check_whole(imported, len(VideoFile(self.video).numbers))
        known = np.isfinite(self.hips).all(1)
        skeleton, index = imported.body.skeleton, self.seen[self.name].frames[known]
        moved = skeleton.joint_transforms(imported.motion.rotations[index], imported.motion.translations[index])
        middle = moved[..., :3, 3][:, [skeleton.names.index(name) for name in HIPS]].mean(1)
        found = (middle @ own.world_to_camera[:3, :3].T + own.world_to_camera[:3, 3])[:, 2]
        true = (self.hips[known] @ here.rotation.T + here.translation)[:, 2]
        size = float(np.median(found / true))
        frames, cameras = [], {}
        for name in sorted(self.cameras.keys() - {self.name}):
            cameras[name] = _placed(self.cameras[name], here, size, own, self.seen[name].image_size)
            frames += list(self._images(name, cameras[name], out))
        result = Capture(out, cameras, {}, imported.body, imported.motion, tuple(frames))
        save_capture(result, size=size)
        return load_capture(out)

    def _images(self, name: str, camera: Camera, out: Path) -> Iterator[Frame]:
        """Write images and masks of the instants of a camera; their frames."""
        seen, video = self.seen[name], VideoFile(self._video(name))
        distortion = tuple(map(float, self.cameras[name].distortion))
        for k in spaced_indices(len(seen), INSTANTS):
            number = int(seen.frames[k])
            image, mask = (undistort_image(a, camera, distortion) for a in (video.frame(number), seen.masks[k]))
            stem = f"{name}_{number:04d}"
            write_image(out / "images" / f"{stem}.png", premultiplied(image, mask))
            write_image(out / "masks" / f"{stem}.png", mask)
            yield Frame(f"images/{stem}.png", f"masks/{stem}.png", name, number, "novel_view")


def other_cameras(folder: Path, out: Path) -> Iterator[tuple[str, Filmed]]:
    """Pose2Sim's scored cameras by name; observations are kept in ``out``."""
    cameras, seen, rows, hips = watched(folder, out, HIPS)
    for name in SCORED:
        found = np.full((len(seen[name].frames), 3), np.nan)
        found[rows[name]] = hips.mean(1)
        yield name, Filmed(name, folder, cameras, seen, found)


def _placed(other: Calibrated, here: Calibrated, size: float, own: Camera, image_size: tuple[int, int]) -> Camera:
    """A camera in the world of ``own``, which stands for ``here`` in a world ``size`` times as large."""
    turn = other.rotation @ here.rotation.T
    from_own = np.eye(4)
    from_own[:3, :3] = turn
    from_own[:3, 3] = size * (other.translation - turn @ here.translation)
    return Camera(image_size[0], image_size[1], other.intrinsics, from_own @ own.world_to_camera)
