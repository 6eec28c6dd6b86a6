"""A video of one person, or a folder of frames, with estimated body poses."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.format import TRAIN_SHARE, Split
from rnd_runtime.core.errors import InputError
from rnd_trainer.checking.silhouette import silhouette
from rnd_trainer.checking.views import shrunk_camera
from rnd_trainer.importing.body_models import BodyModel
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    IMAGE_SUFFIXES,
    Bytes,
    camera_of,
    image_size,
    list_files,
    numbers_of,
    pinhole,
    read_rgb,
)
from rnd_trainer.importing.options import ImportOptions, OnProgress, no_progress
from rnd_trainer.importing.pose_files import PoseFile, pair_with_frames
from rnd_trainer.importing.poses import Floats
from rnd_trainer.importing.scene import PlacedScene, place_scene
from rnd_trainer.importing.select import select_frames, sharpness
from rnd_trainer.importing.videos.video_file import VideoFile

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
FPS = 30.0
CAMERA = "0"
_SMALL = 320  # pixels, the side at which sharpness is measured, insensitive to sensor noise


def detect(source: Path) -> str | None:
    """A video file, or a folder of images that holds no folders."""
    if source.is_file() and source.suffix.lower() in SUFFIXES:
        return "a video"
    if source.is_dir():
        inside = [path for path in source.iterdir() if not path.name.startswith(".")]
        images = any(path.suffix.lower() in IMAGE_SUFFIXES for path in inside)
        if images and all(path.is_file() for path in inside):
            return "a folder of frames"
    return None


class FrameFolder:
    """A folder of frames with the interface of ``VideoFile``.

    ``numbers`` are those in the images' names where ``numbered`` and all have one; otherwise they count from 0.
    """

    def __init__(self, path: Path, numbered: bool) -> None:
        files = list_files(path)
        named = numbers_of(files) if numbered else None
        self.files = dict(sorted(zip(named or range(len(files)), files)))
        self.numbers = list(self.files)
        self.path = path
        self.width, self.height = image_size(self.files[self.numbers[0]])

    def name(self, number: int) -> str:
        return self.files[number].stem

    def frame(self, number: int) -> Bytes:
        path = self.files[number]
        pixels = read_rgb(path)
        if pixels.shape[:2] != (self.height, self.width):
            expected, got = (f"{self.width} x {self.height} as the first", f"{pixels.shape[1]} x {pixels.shape[0]}")
            raise InputError("size of image", expected=expected, got=got, file=path, frame=number)
        return pixels


def read(
    source: Path, model: BodyModel, found: PoseFile, options: ImportOptions, on_progress: OnProgress = no_progress
) -> ImportedDataset:
    """Read a video; of the frames that ``options.selection`` keeps, take the sharpest of each pose.

    The lens is ``options.intrinsics``, else the pose file's, else what its program assumed. The first 4/5 of the frames
    give ``options.count`` training images, the last 1/5 a quarter of that as novel poses. A frame is known by its
    number in the video or the folder's order, from 0; for numbered poses and images, by those numbers.
    """
    video: VideoFile | FrameFolder
    if source.is_file():
        video = VideoFile(source)
        fps = options.fps or video.fps
        found = replace(found, notes=(*video.notes, *found.notes))
    else:
        video = FrameFolder(source, found.numbered)
        fps = options.fps or found.fps or FPS
    K, notes = _intrinsics(found, video.width, video.height, options.intrinsics)
    camera = camera_of(K, np.eye(3), np.zeros(3), (video.width, video.height), corner=0)
    if found.fps is not None and abs(found.fps - fps) > 0.01 * fps:
        notes += (f"poses have {found.fps:g} frames per second, images {fps:g}: paired frame by frame",)
    poses, paired = pair_with_frames(found, video.numbers, video.path)
    lenses, notes = {CAMERA: Lens(camera, options.distortion)}, (*found.notes, *notes, *paired)
    dataset = ImportedDataset(f"a video with {found.kind}'s poses", lenses, [], poses, fps, notes)
    chosen = choose_frames(video, place_scene(dataset, model), dataset, options, on_progress)
    stills = stills_of(video, [frame for frame, _ in chosen])
    samples = [
        Sample(CAMERA, frame, partial(stills.__getitem__, k), split=split, name=video.name(frame))
        for k, (frame, split) in enumerate(chosen)
    ]
    kept = f"{len(samples)} of {len(video.numbers)} frames kept, the sharpest of each pose"
    names = {frame: video.name(frame) for frame in video.numbers}
    return replace(dataset, samples=samples, notes=(*notes, kept), image_names=names)


def _intrinsics(found: PoseFile, width: int, height: int, given: tuple[float, ...]) -> tuple[Floats, tuple[str, ...]]:
    own = found.K
    if own is None and found.focal is not None:
        focal = found.focal(width, height)
        own = pinhole(focal, focal, width / 2, height / 2)
    if len(given) not in (0, 4):
        raise InputError("--intrinsics", expected="fx fy cx cy", got=" ".join(map(str, given)))
    if given:
        K = pinhole(*given)
        if own is None or np.abs(K - own).max() <= 0.02 * own[0, 0]:
            return K, ()
        assumed = f"{found.kind} assumed a focal length of {own[0, 0]:.0f}, --intrinsics is {given[0]:.0f}"
        return K, (f"{assumed}: poses may miss",)
    if own is None:
        raise InputError("lens", expected="--intrinsics fx fy cx cy, as the pose file has none", got="none")
    return own, (f"focal length {own[0, 0]:.0f} pixels, as {found.kind} has it",)


def choose_frames(
    video: VideoFile | FrameFolder,
    scene: PlacedScene,
    dataset: ImportedDataset,
    options: ImportOptions,
    on_progress: OnProgress,
) -> list[tuple[int, Split]]:
    """(frame, split) of the frames to keep, ascending."""
    selection, motion = options.selection, scene.motion
    first = int(dataset.poses.frames[0])
    last = min(first + motion.frame_count, video.numbers[-1] + 1)
    posed = set(video.numbers).intersection(dataset.poses.frames.tolist())
    start = max(first, video.numbers[0], selection.start) - first
    stop = min(last, last if selection.stop is None else selection.stop) - first
    camera = shrunk_camera(scene.cameras[CAMERA], _SMALL)
    sharp = np.full(motion.frame_count, -np.inf)
    for k in range(start, stop):
        on_progress("choosing frames", k - start, stop - start)
        if first + k not in posed or not selection.keeps(first + k):
            continue
        image = cv2.resize(video.frame(first + k), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        vertices = posed_vertices(scene.body, motion.rotations[k], motion.translations[k])
        covered = silhouette(vertices, scene.body.faces, camera)
        if covered.any():
            sharp[k] = sharpness(image, np.where(covered, 255, 0).astype(np.uint8))
    border = start + max(1, round(TRAIN_SHARE * (stop - start)))
    early, late = sharp.copy(), sharp.copy()
    early[border:], late[:border] = -np.inf, -np.inf
    if not np.isfinite(early).any():
        raise InputError("frames", expected="some with poses and the person in view", got="none", file=video.path)
    chosen: list[tuple[int, Split]] = []
    parts: list[tuple[np.ndarray, int, Split]] = [
        (early, options.count, "train"),
        (late, max(1, options.count // 4), "novel_pose"),
    ]
    for scores, number, split in parts:
        if np.isfinite(scores).any():
            picked = select_frames(motion, scene.body.skeleton, scores, number)
            chosen += [(first + int(k), split) for k in picked]
    return sorted(chosen)


def stills_of(video: VideoFile | FrameFolder, frames: list[int]) -> np.ndarray:
    """Frames [n, H, W, 3] uint8 in a temporary file, for random access."""
    with tempfile.TemporaryFile() as file:
        if hasattr(os, "posix_fallocate"):  # otherwise a full disk is a bus error
            os.posix_fallocate(file.fileno(), 0, len(frames) * video.height * video.width * 3)
        stills = np.memmap(file, np.uint8, "w+", shape=(len(frames), video.height, video.width, 3))
        for k, frame in enumerate(frames):
            stills[k] = video.frame(frame)
    return stills
