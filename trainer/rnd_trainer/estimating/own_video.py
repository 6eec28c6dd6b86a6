"""From a video of one person, and nothing else, to a capture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.cli.lock import folder_lock
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import output_folder
from rnd_runtime.core.rotations import slerp_matrices
from rnd_runtime.motion.motion import Motion
from rnd_trainer.checking.silhouette import silhouette
from rnd_trainer.checking.views import shrunk_camera
from rnd_trainer.importing.body_models import load_body_model
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.importer import check_numbers, find_layout, refuse_occupied, refuse_unwritable
from rnd_trainer.importing.layouts import video as video_layout
from rnd_trainer.importing.options import ImportOptions, OnProgress, no_progress
from rnd_trainer.importing.poses import Poses
from rnd_trainer.importing.scene import PlacedScene
from rnd_trainer.importing.surfaces.estimate import add_albedos, add_normals
from rnd_trainer.importing.surfaces.files import attach_files
from rnd_trainer.importing.videos.undistorted import undistorted
from rnd_trainer.importing.videos.video_file import VideoFile
from rnd_trainer.importing.write import write_capture
from rnd_trainer.training.poses.uncertainty import PoseUncertainty, save_uncertainty

from .film_notes import cut_off, film_notes, refuse_unusable
from .fit import Estimate, estimate
from .observations import Observations
from .observing.camera_motion import Steady, steady
from .observing.frame_rate import Regular, regular
from .observing.observe import MIN_FRAMES, Networks, observe
from .opencv_threads import opencv_on_one_thread
from .overlay import SIDE, write_overlay

Floats = NDArray[np.float64]

_HIDDEN = 0.02  # share of the body's silhouette behind others from which a frame is not trained on


def is_own_video(source: Path, options: ImportOptions) -> bool:
    """Whether ``source`` is a video without body poses."""
    return options.poses is None and source.exists() and find_layout(source, options.layout)[0] == "video"


def is_video_file(source: Path) -> bool:
    """Whether ``source`` is a file with a video's suffix."""
    return source.is_file() and source.suffix.lower() in video_layout.SUFFIXES


@opencv_on_one_thread()
def import_video(
    source: Path,
    out: Path,
    options: ImportOptions,
    *,
    on_progress: OnProgress = no_progress,
    on_found: Callable[[str], None] = lambda sentence: None,
) -> PlacedScene:
    """Turn a video, or a folder of frames, of one person into a capture in the folder ``out``.

    Beside the capture, ``check/overlay.mp4`` shows what was seen and fitted.

    Args:
        on_progress: called with (phase, done, total).
        on_found: called with what was found, a sentence each.

    Raises:
        InputError: in one line, for a video that cannot be used; nothing is written then.
    """
    check_numbers(options)
    if len(options.intrinsics) not in (0, 4):
        raise InputError("--intrinsics", expected="fx fy cx cy", got=" ".join(map(str, options.intrinsics)))
    refuse_occupied(out, source, options)
    refuse_unwritable(out)
    networks = Networks.open()
    video: Any
    video, numbers = _frames(source, options)
    video = undistorted(video, options.intrinsics, options.distortion)
    on_found(f"{source.name}: {len(numbers)} frames of {video.width} x {video.height}, {video.fps:g} a second")
    try:
        people = [one.region for one in networks.detector(video.frame(numbers[0]))]
        video = steady(video, numbers, people, partial(on_progress, "camera"))
        seen = observe(video, networks, numbers=numbers, person=options.person, on_progress=on_progress)
        refuse_unusable(seen, video.frame)
    except InputError as error:
        raise error.at(file=source) from error
    on_found(f"a person in {len(seen)} of {len(numbers)} frames")
    fitted = _fitted(seen, options, on_progress)
    left_out = _left_out(seen, fitted)
    notes = [*_video_notes(video, numbers, seen, left_out), *fitted.notes]
    notes += film_notes(seen, facing(fitted), video.frame)
    scene, dataset = _placed(seen, fitted, options, notes)
    dataset = _with_samples(dataset, scene, video, seen, left_out, options, on_progress)
    dataset = attach_files(dataset, options)
    samples, axes = add_normals(list(dataset.samples), scene, dataset, options)
    samples = add_albedos(samples, options.albedo_net)
    with folder_lock(output_folder(out), "rnd-data import"):
        refuse_occupied(out, source, options)
        save_uncertainty(out, _deviations(fitted))
        overlay = output_folder(out / "check") / "overlay.mp4"
        shown = partial(on_progress, "overlay")
        write_overlay(overlay, seen, video.frame, fitted.body, fitted.motion, fitted.camera, left_out, shown)
        write_capture(out, dataset, scene, samples, on_progress, normal_axes=axes)
    return scene


def facing(fitted: Estimate) -> Floats:
    """Direction [T] of the chest about the vertical, degrees: 0 towards the camera, 90 where it sees the left side."""
    pose = np.linalg.inv(fitted.camera.world_to_camera)
    chest = fitted.motion.rotations[:, 0] @ np.array([0, 0, 1.0])
    to_camera = pose[:3, 3] - fitted.motion.translations
    turn = np.arctan2(chest[:, 0], chest[:, 2]) - np.arctan2(to_camera[:, 0], to_camera[:, 2])
    return np.asarray((-np.degrees(turn) + 180) % 360 - 180)


def _frames(source: Path, options: ImportOptions) -> tuple[Any, list[int]]:
    """The video at even times, and the numbers of the frames to use."""
    if source.is_file():
        video: Any = regular(VideoFile(source))
    else:
        video = video_layout.FrameFolder(source, numbered=False)
        video.fps = options.fps or video_layout.FPS
    numbers = [number for number in video.numbers if options.selection.keeps(number)]
    if len(numbers) < MIN_FRAMES:
        expected = f"at least {MIN_FRAMES} frames of a person who turns round"
        raise InputError("video", expected=expected, got=len(numbers), file=source)
    return video, numbers


def _fitted(seen: Observations, options: ImportOptions, on_progress: OnProgress) -> Estimate:
    lens = options.intrinsics
    return estimate(
        seen,
        body=None if options.body is None else load_body_model(options.body).shaped(None),
        height=options.height,
        focal_px=lens[0] if lens else None,
        principal_px=(lens[2], lens[3]) if lens else None,
        on_progress=lambda done, total: on_progress("fitting the body", int(done), int(total)),
    )


def _placed(
    seen: Observations, fitted: Estimate, options: ImportOptions, notes: list[str]
) -> tuple[PlacedScene, ImportedDataset]:
    frames, motion = fitted.frames, fitted.motion
    root = motion.translations + fitted.body.skeleton.rest_joints[0]
    poses = Poses(frames, motion.rotations, lambda _: root, fitted.body.skeleton.names)
    lenses = {video_layout.CAMERA: Lens(fitted.camera, (), options.distortion)}
    dataset = ImportedDataset("a video", lenses, [], poses, seen.fps, tuple(notes))
    every = _every_frame(frames, motion)
    scene = PlacedScene(fitted.body, every, {video_layout.CAMERA: fitted.camera}, np.eye(3), notes)
    return scene, dataset


def _every_frame(frames: NDArray[np.int64], motion: Motion) -> Motion:
    """A pose for every frame from first to last; missing ones are slerped."""
    every = np.arange(frames[0], frames[-1] + 1)
    after = np.minimum(np.searchsorted(frames, every, side="right"), len(frames) - 1)
    before = np.maximum(np.searchsorted(frames, every, side="right") - 1, 0)
    t = ((every - frames[before]) / np.maximum(frames[after] - frames[before], 1))[:, None]
    rotations = slerp_matrices(motion.rotations[before], motion.rotations[after], t)
    positions = (1 - t) * motion.translations[before] + t * motion.translations[after]
    return replace(motion, rotations=rotations, translations=positions)


def _with_samples(
    dataset: ImportedDataset,
    scene: PlacedScene,
    video: Any,
    seen: Observations,
    left_out: dict[int, str],
    options: ImportOptions,
    on_progress: OnProgress,
) -> ImportedDataset:
    """``dataset`` with the sharpest frame of each pose and its mask."""
    whole = ~np.isin(seen.frames, list(left_out))
    known = replace(dataset, poses=_poses_of(dataset.poses, whole)) if whole.any() else dataset
    chosen = video_layout.choose_frames(video, scene, known, options, on_progress)
    stills = video_layout.stills_of(video, [frame for frame, _ in chosen])
    index = {int(frame): k for k, frame in enumerate(seen.frames)}
    samples = [
        Sample(
            video_layout.CAMERA,
            frame,
            partial(stills.__getitem__, k),
            mask=partial(seen.masks.__getitem__, index[frame]),
            split=split,
        )
        for k, (frame, split) in enumerate(chosen)
    ]
    return replace(dataset, samples=samples)


def _poses_of(poses: Poses, chosen: NDArray[np.bool_]) -> Poses:
    """Some of ``poses``, and always the first: motion frames count from it."""
    chosen = chosen.copy()
    chosen[0] = True
    root = poses.root(np.zeros(3))[chosen]
    return replace(poses, frames=poses.frames[chosen], rotations=poses.rotations[chosen], root=lambda _: root)


def _video_notes(video: Any, numbers: list[int], seen: Observations, left_out: dict[int, str]) -> list[str]:
    notes = list(getattr(video, "notes", ()))
    inner = video
    while not isinstance(inner, Regular) and hasattr(inner, "video"):
        inner = inner.video
    if isinstance(inner, Regular):
        notes.append(f"frames of uneven times: taken at {inner.fps:.3g} a second")
    if isinstance(video, Steady) and video.homographies:
        notes.append(f"hand-held: sway of {video.moved_px:.1f} pixels was taken out by the background")
    missing = len(numbers) - len(seen)
    if missing:
        notes.append(f"{missing} of {len(numbers)} frames left out: the person was not seen")
    for reason, count in Counter(left_out.values()).items():
        notes.append(f"{count} of {len(seen)} frames are not trained on: {reason}")
    return notes


def _left_out(seen: Observations, fitted: Estimate) -> dict[int, str]:
    """Why frames are not trained on, by their numbers."""
    reasons = dict.fromkeys(seen.frames[cut_off(seen)].tolist(), "cut off by the image")
    if seen.hidden is None:
        return reasons
    small = shrunk_camera(fitted.camera, SIDE)
    for k, number in enumerate(seen.frames.tolist()):
        hidden = cv2.resize(seen.hidden[k], (small.width, small.height), interpolation=cv2.INTER_AREA) > 127
        vertices = posed_vertices(fitted.body, fitted.motion.rotations[k], fitted.motion.translations[k])
        covered = silhouette(vertices, fitted.body.faces, small)
        if (covered & hidden).sum() > _HIDDEN * covered.sum():
            reasons.setdefault(number, "behind somebody")
    return reasons


def _deviations(fitted: Estimate) -> PoseUncertainty:
    """Of the motion's frames; those between observed ones take the nearest."""
    every = np.arange(fitted.frames[0], fitted.frames[-1] + 1)
    nearest = np.abs(every[:, None] - fitted.frames).argmin(1)
    return PoseUncertainty(fitted.rotation_deviation[nearest], fitted.translation_deviation[nearest])
