"""A plain video of one person, or a folder of its frames, with body poses from a program that estimates them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.format import TRAIN_SHARE, Split
from rnd_runtime.core.errors import InputError
from rnd_trainer.checking.silhouette import silhouette

from .body_models import BodyModel
from .frames import Film
from .images import PICTURES, Bytes, camera_of, listed, numbers_of, read_rgb, sized
from .options import ALL, Choice
from .pose_files import FoundPoses, paired
from .recording import Floats, Lens, Recording, Shot
from .select import select_frames, sharpness
from .write import Scene, placed

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
FPS = 30.0
CAMERA = "0"
_SMALL = 320  # pixels, the side at which sharpness is measured: motion blur shows there, sensor noise does not


def detect(source: Path) -> str | None:
    """A video file, or a folder of pictures that holds no folders."""
    if source.is_file() and source.suffix.lower() in SUFFIXES:
        return "a video"
    if source.is_dir():
        inside = [path for path in source.iterdir() if not path.name.startswith(".")]
        pictures = any(path.suffix.lower() in PICTURES for path in inside)
        if pictures and all(path.is_file() for path in inside):
            return "a folder of frames"
    return None


class _Folder:
    """A folder of frames with a ``Film``'s face.

    Its ``numbers`` count the pictures from 0; where ``numbered``, they are those in their names, if all have one.
    """

    def __init__(self, path: Path, fps: float, numbered: bool) -> None:
        files = listed(path)
        named = numbers_of(files) if numbered else None
        self.pictures = dict(sorted(zip(named or range(len(files)), files)))
        self.numbers = list(self.pictures)
        self.path, self.fps, self.count = path, fps, len(files)
        self.width, self.height = sized(self.pictures[self.numbers[0]])

    def name(self, number: int) -> str:
        return self.pictures[number].stem

    def frame(self, number: int) -> Bytes:
        pixels, path = read_rgb(self.pictures[number]), self.pictures[number]
        if pixels.shape[:2] != (self.height, self.width):
            expected, got = (f"{self.width} x {self.height} as the first", f"{pixels.shape[1]} x {pixels.shape[0]}")
            raise InputError("size of image", expected=expected, got=got, file=path, frame=number)
        return pixels


def read(
    source: Path,
    model: BodyModel,
    found: FoundPoses,
    *,
    intrinsics: Sequence[float] = (),
    distortion: Sequence[float] = (),
    count: int = 100,
    fps: float | None = None,
    choice: Choice = ALL,
) -> Recording:
    """Read a video; of the frames that ``choice`` may take, keep the sharpest of each pose.

    The lens is ``intrinsics`` (fx, fy, cx, cy in pixels), else the pose file's, else what its program assumed. Poses
    fit the pictures through the lens they were estimated with; another one is noted. The first 4/5 of those frames give
    ``count`` training pictures, the last 1/5 a quarter of that as novel poses.

    A frame is known by its number in the video or the folder's order, from 0; where each pose has a numbered file and
    each picture a number, by those.
    """
    film = Film(source) if source.is_file() else _Folder(source, FPS, found.numbered)
    rate = fps or (film.fps if source.is_file() else found.fps or FPS)
    K, notes = _lens(found, film.width, film.height, intrinsics)
    lens = Lens(camera_of(K, np.eye(3), np.zeros(3), (film.width, film.height), corner=0), tuple(distortion))
    if found.fps is not None and abs(found.fps - rate) > 0.01 * rate:
        notes += (f"poses have {found.fps:g} frames per second, pictures {rate:g}: paired frame by frame",)
    poses, counted = paired(found, film.numbers, film.path)
    recording = Recording(
        f"a video with {found.kind}'s poses", {CAMERA: lens}, [], poses, rate, (*found.notes, *notes, *counted)
    )
    chosen = _choose(film, placed(recording, model), recording, count, choice)
    stills = _stills(film, [frame for frame, _ in chosen])
    shots = [
        Shot(CAMERA, frame, partial(stills.__getitem__, k), split=split, name=film.name(frame))
        for k, (frame, split) in enumerate(chosen)
    ]
    kept = f"{len(shots)} of {film.count} frames kept, the sharpest of each pose"
    names = {frame: film.name(frame) for frame in film.numbers}
    return replace(recording, shots=shots, notes=(*recording.notes, kept), film=names)


def _lens(found: FoundPoses, width: int, height: int, intrinsics: Sequence[float]) -> tuple[Floats, tuple[str, ...]]:
    own = found.K
    if own is None and found.focal is not None:
        focal = found.focal(width, height)
        own = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    if len(intrinsics) not in (0, 4):
        raise InputError("--intrinsics", expected="fx fy cx cy", got=" ".join(map(str, intrinsics)))
    if intrinsics:
        fx, fy, cx, cy = intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        differs = own is not None and np.abs(K - own).max() > 0.02 * own[0, 0]
        if own is not None and differs:
            return K, (
                f"{found.kind} assumed a focal length of {own[0, 0]:.0f}, --intrinsics says {fx:.0f}: poses may miss",
            )
        return K, ()
    if own is None:
        raise InputError("lens", expected="--intrinsics fx fy cx cy, as the pose file has none", got="none")
    return own, (f"focal length {own[0, 0]:.0f} pixels, as {found.kind} has it",)


def _choose(
    film: Film | _Folder, scene: Scene, recording: Recording, count: int, choice: Choice
) -> list[tuple[int, Split]]:
    """(frame, split) of the frames to keep, ascending."""
    first = int(recording.poses.frames[0])
    last = min(first + scene.motion.frame_count, film.numbers[-1] + 1)
    posed = set(film.numbers).intersection(recording.poses.frames.tolist())
    given = {frame - first for frame in posed if choice.keeps(frame)}
    start = max(first, film.numbers[0], choice.start) - first
    stop = min(last, last if choice.stop is None else choice.stop) - first
    camera = scene.cameras[CAMERA]
    factor = min(1.0, _SMALL / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    sharp = np.full(scene.motion.frame_count, -np.inf)
    for k in range(start, stop):
        if k not in given:
            continue
        picture = cv2.resize(film.frame(first + k), (small.width, small.height), interpolation=cv2.INTER_AREA)
        vertices = posed_vertices(scene.body, scene.motion.rotations[k], scene.motion.translations[k])
        covered = silhouette(vertices, scene.body.faces, small)
        if covered.any():
            sharp[k] = sharpness(picture, np.where(covered, 255, 0).astype(np.uint8))
    border = start + max(1, round(TRAIN_SHARE * (stop - start)))
    early, late = sharp.copy(), sharp.copy()
    early[border:], late[:border] = -np.inf, -np.inf
    if not np.isfinite(early).any():
        raise InputError("frames", expected="some with poses and the person in view", got="none", file=film.path)
    chosen: list[tuple[int, Split]] = []
    parts: list[tuple[np.ndarray, int, Split]] = [(early, count, "train"), (late, max(1, count // 4), "novel_pose")]
    for scores, number, split in parts:
        if np.isfinite(scores).any():
            picked = select_frames(scene.motion, scene.body.skeleton, scores, number)
            chosen += [(first + int(k), split) for k in picked]
    return sorted(chosen)


def _stills(film: Film | _Folder, frames: list[int]) -> np.ndarray:
    """The frames [n, H, W, 3] uint8 on disk: masks need them in any order, a video gives them in its own."""
    with tempfile.TemporaryFile() as file:
        if hasattr(os, "posix_fallocate"):  # now: a page that the disk does not have later is a bus error
            os.posix_fallocate(file.fileno(), 0, len(frames) * film.height * film.width * 3)
        stills = np.memmap(file, np.uint8, "w+", shape=(len(frames), film.height, film.width, 3))
        for k, frame in enumerate(frames):
            stills[k] = film.frame(frame)
    return stills
