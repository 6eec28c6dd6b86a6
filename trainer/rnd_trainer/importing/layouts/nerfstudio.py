"""nerfstudio's and instant-ngp's transforms.json, with body poses from a file beside it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_header
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    camera_of,
    image_size,
    mask_reader,
    natural_key,
    numbers_of,
    pinhole,
    read_json,
    read_rgb,
)
from rnd_trainer.importing.pose_files import pair_with_frames, poses_in_world, read_poses

FPS = 30.0
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_POSES = ("poses.npz", "smpl.npz", "motion.npz", "smpl_params.npz")


def detect(source: Path) -> str | None:
    """ "transforms.json" with frames."""
    file = _transforms(source)
    if file.name != "transforms.json" or not file.is_file():
        return None
    record = read_json(file)
    return "transforms.json" if isinstance(record, dict) and "frames" in record else None


def read(source: Path, *, poses: Path | None = None, person: int | None = None) -> ImportedDataset:
    """Read cameras (OpenGL's camera-to-world, pixel centres at +0.5) and images.

    Images that share a lens and a camera pose share a camera. Frame numbers are ``time_index``/``frame`` where given.
    Otherwise several cameras with equally many images, more than one, saw every moment: the n-th image of each, by
    name, is frame n. All others are one camera that may move, a frame an image, numbered by name for numbered pose
    files, else in the order of their names. ``poses`` is any file of ``pose_files.read_poses``. Default: a file called
    poses.npz, smpl.npz, motion.npz or smpl_params.npz beside transforms.json.
    """
    file = _transforms(source)
    record = read_json(file)
    entries = record["frames"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("frames", expected="a list of at least one frame", got=repr(entries)[:60], file=file)
    timed = any(_time(entry) is not None for entry in entries)
    if not timed:
        entries = sorted(entries, key=lambda entry: natural_key(str(entry.get("file_path"))))
    lenses: dict[str, Lens] = {}
    names: dict[bytes, str] = {}
    counts: dict[str, int] = {}
    samples, images = [], []
    for entry in entries:
        image = _image_path(file.parent, entry.get("file_path"), file)
        lens = _lens({**record, **entry}, image, file)
        name = names.setdefault(_key(lens), f"{len(names):04d}")
        lenses.setdefault(name, lens)
        time = _time(entry)
        number = counts.get(name, 0) if time is None else time
        counts[name] = number + 1
        mask = file.parent / entry["mask_path"] if entry.get("mask_path") else None
        if mask is None and len(read_header(image).channels) == 4:
            mask = image
        images.append(image)
        samples.append(Sample(name, number, partial(read_rgb, image), mask_reader(mask), name=image.stem))
    pose_file = poses or next((file.parent / name for name in _POSES if (file.parent / name).is_file()), None)
    if pose_file is None:
        raise InputError("body poses", expected="--poses FILE, as transforms.json has none", got="none", file=file)
    found = read_poses(pose_file, person=person)
    found = replace(found, poses=poses_in_world(found, list(lenses.values()), file))
    body_poses, notes = found.poses, found.notes
    if not timed:
        several = 1 < len(names) < len(samples) and len(set(counts.values())) == 1
        if not several:
            numbers = (numbers_of(images) if found.numbered else None) or range(len(samples))
            samples = [replace(sample, frame=number) for sample, number in zip(samples, numbers)]
        body_poses, more = pair_with_frames(found, sorted({sample.frame for sample in samples}), file)
        notes += more
    return ImportedDataset("nerfstudio transforms.json", lenses, samples, body_poses, found.fps or FPS, notes)


def _transforms(source: Path) -> Path:
    return source / "transforms.json" if source.is_dir() else source


def _time(entry: dict[str, Any]) -> int | None:
    return next((int(entry[key]) for key in ("time_index", "frame") if entry.get(key) is not None), None)


def _image_path(folder: Path, name: Any, file: Path) -> Path:
    if not isinstance(name, str):
        raise InputError("file_path", expected="a path in every frame", got=name, file=file)
    path = folder / name
    return path if path.suffix else path.with_suffix(".png")  # instant-ngp's synthetic scenes omit it


def _lens(entry: dict[str, Any], image: Path, file: Path) -> Lens:
    model = entry.get("camera_model") or "OPENCV"
    if model not in _MODELS:
        raise InputError("camera_model", expected=" or ".join(_MODELS), got=model, file=file)
    for name in ("is_fisheye", "k4"):
        if entry.get(name):
            raise InputError(name, expected="a pinhole with OpenCV's k1 k2 p1 p2 k3", got=entry[name], file=file)
    try:
        width, height = (int(entry["w"]), int(entry["h"])) if "w" in entry else image_size(image)
        fx = float(entry["fl_x"]) if "fl_x" in entry else 0.5 * width / np.tan(0.5 * float(entry["camera_angle_x"]))
        fy, cx, cy = (float(entry.get(k, d)) for k, d in (("fl_y", fx), ("cx", width / 2), ("cy", height / 2)))
        pose = np.linalg.inv(np.asarray(entry["transform_matrix"], np.float64).reshape(4, 4) @ _FLIP)
        distortion = tuple(float(entry.get(k, 0)) for k in _DISTORTION)
    except (KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        expected = "fl_x or camera_angle_x, transform_matrix"
        raise InputError("frame", expected=expected, got=repr(error), file=file) from error
    camera = camera_of(pinhole(fx, fy, cx, cy), pose[:3, :3], pose[:3, 3], (width, height), corner=0)
    return Lens(camera, distortion if any(distortion) else ())


def _key(lens: Lens) -> bytes:
    """Equal for equal lenses at one camera pose, to nine decimals."""
    pose = np.round(lens.camera.world_to_camera, 9) + 0.0  # no negative zeros
    return lens.camera.K.tobytes() + pose.tobytes() + repr(lens.distortion).encode()
