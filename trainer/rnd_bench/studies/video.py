"""``rnd-bench study video``: poses estimated from a video alone against the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from rnd_bench.lifter.captured import observed
from rnd_bench.lifter.pose2sim import SCORED, watched
from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import output_file, output_folder, write_json
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.playback.doctor import machine
from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.estimating.fit import Estimate, estimate
from rnd_trainer.estimating.fitting.figure import JOINTS, default_figure
from rnd_trainer.estimating.fitting.marks import marks_of
from rnd_trainer.estimating.fitting.state import TO_CAMERA
from rnd_trainer.estimating.fitting.terms import mark_points
from rnd_trainer.estimating.observations import BLAZEPOSE, Observations
from rnd_trainer.estimating.own_video import import_video
from rnd_trainer.importing.options import ImportOptions
from rnd_trainer.importing.videos.video_file import VideoFile

from .video_options import Video

Floats = NDArray[np.float64]

LIMBS = tuple(
    f"{side}_{name}" for name in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist") for side in ("left", "right")
)
IOU_EVERY = 4  # frames


def run(options: Video) -> None:
    """Observe, fit, score; print the table, write the rows."""
    out = output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    if len(options.capture) != len(options.video):
        raise InputError("--video", expected=f"{len(options.capture)}, one of each capture", got=len(options.video))
    rows: list[dict[str, Any]] = []
    with Progress() as progress:
        for folder, video in zip(options.capture, options.video):
            progress.phase(video.stem)
            seen = observed(video, out / f"{video.stem}.npz")
            rows += [{"video": video.stem, **row} for row in _rendered(load_capture(folder), seen)]
        films = list(options.video)
        if options.real is not None:
            progress.phase("real cameras")
            rows += list(_real(options.real, out))
            films += [options.real / "videos" / f"{name}.mp4" for name in SCORED]
        progress.phase("imports")
        imports = [import_times(film, out) for film in films]
    if options.json is not None:
        write_json(options.json, {"machine": machine(), "rows": rows, "imports": imports})
    figures = ("absolute_mm", "root_relative_mm", "pa_mm", "mask_iou", "outline_iou", "seconds_a_frame")
    table = Table("video", "given", *figures)
    for row in rows:
        table.add_row(row["video"], row["given"], *(f"{row[f]:.3g}" if row.get(f) is not None else "" for f in figures))
    Console(width=120, soft_wrap=True).print(table)


def _rendered(capture: Capture, seen: Observations) -> Iterator[dict[str, Any]]:
    frames = sorted(capture.split("train"), key=lambda frame: frame.frame)
    if len(frames) <= seen.frames.max():
        raise InputError("video", expected=f"of the capture's {len(frames)} frames", got=int(seen.frames.max()) + 1)
    chosen = [frames[k] for k in seen.frames]
    index = [frame.frame for frame in chosen]
    camera, skeleton = capture.cameras[chosen[0].camera], capture.body.skeleton
    moved = skeleton.joint_transforms(capture.motion.rotations[index], capture.motion.translations[index])
    truth = _in_camera(moved[:, :, :3, 3], camera)
    masks = [capture.load_frame(frame).mask > 0.5 for frame in chosen[::IOU_EVERY]]
    found_masks = [seen.masks[k] > 127 for k in range(0, len(seen), IOU_EVERY)]
    of_masks = float(np.mean([mask_iou(*pair) for pair in zip(found_masks, masks)]))
    own = {"body": capture.body, "focal_px": float(camera.K[0, 0])}
    for given, options in (("nothing", {}), ("body and focal length", own)):
        start = time.process_time()
        found = estimate(seen, **options)  # type: ignore[arg-type]
        seconds = (time.process_time() - start) / len(seen)
        joints = camera_joints(found)
        every = _scores(joints, truth, found.body.skeleton, skeleton, JOINTS)
        limbs = _scores(joints, truth, found.body.skeleton, skeleton, LIMBS)
        yield {
            "given": given,
            "frames": len(seen),
            **every,
            "limbs": limbs,
            "mask_iou": of_masks,
            "outline_iou": outline_iou(found, masks, IOU_EVERY),
            "focal_px": float(found.camera.K[0, 0]),
            "true_focal_px": float(camera.K[0, 0]),
            "seconds_a_frame": seconds,
        }


def _real(folder: Path, out: Path) -> Iterator[dict[str, Any]]:
    cameras, seen, rows, points = watched(folder, out, LIMBS)
    whole = np.isfinite(points).all((1, 2))
    for name in SCORED:
        start = time.process_time()
        found = estimate(seen[name])
        seconds = (time.process_time() - start) / len(seen[name])
        order = [found.body.skeleton.names.index(n) for n in LIMBS]
        joints = camera_joints(found)[rows[name]][:, order][whole]
        landmarks = camera_landmarks(found, LIMBS)[rows[name]][whole]
        truth = points[whole] @ cameras[name].rotation.T + cameras[name].translation
        yield {
            "video": f"Pose2Sim {name}",
            "given": "nothing",
            "frames": int(whole.sum()),
            **_errors(landmarks, truth, landmarks[:, :2].mean(1), truth[:, :2].mean(1)),
            "joints": _errors(joints, truth, joints[:, :2].mean(1), truth[:, :2].mean(1)),
            "focal_px": float(found.camera.K[0, 0]),
            "true_focal_px": float(cameras[name].intrinsics[0, 0]),
            "seconds_a_frame": seconds,
        }


def import_times(film: Path, out: Path) -> dict[str, Any]:
    """Seconds that a video alone takes to become a capture, networks included, and seconds of CPU a frame."""
    video = VideoFile(film)
    with TemporaryDirectory(dir=out) as folder:
        start, used = time.perf_counter(), time.process_time()
        import_video(film, Path(folder) / "capture", ImportOptions())
        seconds, used = time.perf_counter() - start, time.process_time() - used
    count = len(video.numbers)
    size = [video.width, video.height]
    return {"video": film.stem, "size": size, "frames": count, "seconds": seconds, "cpu_seconds_a_frame": used / count}


def _in_camera(points: Floats, camera: Camera) -> Floats:
    matrix = np.asarray(camera.world_to_camera, np.float64)
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def camera_joints(found: Estimate) -> Floats:
    """Joints [T, J, 3] m of an estimate in its camera's axes."""
    moved = found.body.skeleton.joint_transforms(found.motion.rotations, found.motion.translations)
    return _in_camera(moved[:, :, :3, 3], found.camera)


def camera_landmarks(found: Estimate, points: Sequence[str]) -> Floats:
    """Positions [T, P, 3] m in the camera's axes at which the default figure of an estimate has BlazePose's ``points``.

    A triangulation of landmarks is of these, not of joints: the network sees hips lower and shoulders higher.
    """
    figure = default_figure()
    placed = mark_points(found.state, found.state.posed(figure), marks_of(figure))
    return np.asarray(placed[:, [BLAZEPOSE.index(point) for point in points]] @ TO_CAMERA)


def _scores(found: Floats, truth: Floats, ours: Skeleton, theirs: Skeleton, names: Sequence[str]) -> dict[str, float]:
    a = found[:, [ours.names.index(name) for name in names]]
    b = truth[:, [theirs.names.index(name) for name in names]]
    return _errors(a, b, found[:, ours.names.index("pelvis")], truth[:, theirs.names.index("pelvis")])


def _errors(found: Floats, truth: Floats, root: Floats, true_root: Floats) -> dict[str, float]:
    """Mean distances, mm: in the camera's axes, from the root, and after a similarity a frame (PA)."""
    relative = (found - root[:, None]) - (truth - true_root[:, None])
    return {
        "absolute_mm": 1e3 * float(np.linalg.norm(found - truth, axis=-1).mean()),
        "root_relative_mm": 1e3 * float(np.linalg.norm(relative, axis=-1).mean()),
        "pa_mm": pa_mm(found, truth),
    }


def pa_mm(found: Floats, truth: Floats) -> float:
    """Mean distance, mm, of points [T, N, 3] after a similarity a frame."""
    return 1e3 * float(np.mean([_aligned(a, b).mean() for a, b in zip(found, truth)]))


def _aligned(found: Floats, truth: Floats) -> Floats:
    """Distances [N] after the similarity that aligns ``found`` [N, 3] best. Source: Umeyama 1991."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, v = np.linalg.svd(a.T @ b)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ v))])
    scale = (s * signs).sum() / max((a**2).sum(), 1e-12)
    return np.asarray(np.linalg.norm(scale * a @ (u * signs) @ v - b, axis=1))


def outline_iou(found: Estimate, masks: Sequence[NDArray[np.bool_]], every: int) -> float:
    """Mean overlap of the posed body's silhouette with ``masks`` of every n-th frame."""
    overlaps = []
    for k, mask in enumerate(masks):
        frame = k * every
        vertices = posed_vertices(found.body, found.motion.rotations[frame], found.motion.translations[frame])
        seen = _in_camera(vertices, found.camera)
        pixels = seen[:, :2] / seen[:, 2:] * np.diag(found.camera.K)[:2] + found.camera.K[:2, 2]
        drawn = np.zeros(mask.shape, np.uint8)
        for triangle in (16 * pixels[found.body.faces]).astype(np.int32):
            cv2.fillConvexPoly(drawn, triangle, 1, shift=4)
        overlaps.append(mask_iou(mask, drawn > 0))
    return float(np.mean(overlaps))
