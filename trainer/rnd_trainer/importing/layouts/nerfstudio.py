"""nerfstudio's and instant-ngp's transforms.json, with body poses from a file beside it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_header
from rnd_trainer.importing.images import camera_of, natural, numbers_of, read_json, read_mask, read_rgb, sized
from rnd_trainer.importing.pose_files import before_cameras, paired, read_poses
from rnd_trainer.importing.recording import Lens, Recording, Shot

FPS = 30.0
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_BENT = ("k1", "k2", "p1", "p2", "k3")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_POSES = ("poses.npz", "smpl.npz", "motion.npz", "smpl_params.npz")


def detect(source: Path) -> str | None:
    """ "transforms.json" with frames."""
    file = source / "transforms.json" if source.is_dir() else source
    if file.name != "transforms.json" or not file.is_file():
        return None
    record = read_json(file)
    return "transforms.json" if isinstance(record, dict) and "frames" in record else None


def read(source: Path, *, poses: Path | None = None, person: int | None = None) -> Recording:
    """Read cameras (OpenGL's camera-to-world, pixel centres at +0.5) and pictures.

    Pictures that share a lens and a place share a camera. Frame numbers are ``time_index``/``frame`` where given. Else
    several cameras with equally many pictures, more than one, saw every moment: the n-th picture of each, by name, is
    frame n. Any others are one that may move, a frame a picture, by the numbers in their names where the poses' files
    are numbered, else in their names' order: nerfstudio lists pictures in any. ``poses`` may be any file of
    ``pose_files.read_poses``; without it a file called poses.npz, smpl.npz, motion.npz or smpl_params.npz is looked
    for beside transforms.json.
    """
    file = source / "transforms.json" if source.is_dir() else source
    record = read_json(file)
    lenses: dict[str, Lens] = {}
    names: dict[bytes, str] = {}
    seen: dict[str, int] = {}
    shots, pictures = [], []
    entries = record["frames"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("frames", expected="a list of at least one frame", got=repr(entries)[:60], file=file)
    timed = any(_time(entry) is not None for entry in entries)
    if not timed:
        entries = sorted(entries, key=lambda entry: natural(str(entry.get("file_path"))))
    for entry in entries:
        picture = _picture(file.parent, entry.get("file_path"), file)
        lens, key = _lens({**record, **entry}, picture, file)
        name = names.setdefault(key, f"{len(names):04d}")
        lenses.setdefault(name, lens)
        time = _time(entry)
        number = seen.get(name, 0) if time is None else time
        seen[name] = number + 1
        mask = entry.get("mask_path")
        read_it = partial(read_mask, file.parent / mask) if mask else _alpha(picture)
        pictures.append(picture)
        shots.append(Shot(name, number, partial(read_rgb, picture), read_it, name=picture.stem))
    pose_file = poses or next((file.parent / name for name in _POSES if (file.parent / name).is_file()), None)
    if pose_file is None:
        raise InputError("body poses", expected="--poses FILE, as transforms.json has none", got="none", file=file)
    found = read_poses(pose_file, person=person)
    found = replace(found, poses=before_cameras(found, list(lenses.values()), file))
    body_poses, notes = found.poses, found.notes
    several = 1 < len(names) < len(shots) and len(set(seen.values())) == 1
    if not several and not timed:  # one camera, that may move
        numbers = (numbers_of(pictures) if found.numbered else None) or range(len(shots))
        shots = [replace(shot, frame=number) for shot, number in zip(shots, numbers)]
    if not timed:
        body_poses, counted = paired(found, sorted({shot.frame for shot in shots}), file)
        notes += counted
    return Recording("nerfstudio transforms.json", lenses, shots, body_poses, found.fps or FPS, notes)


def _time(entry: dict[str, Any]) -> int | None:
    return next((int(entry[key]) for key in ("time_index", "frame") if entry.get(key) is not None), None)


def _picture(folder: Path, name: Any, file: Path) -> Path:
    if not isinstance(name, str):
        raise InputError("file_path", expected="a path in every frame", got=name, file=file)
    path = folder / name
    return path if path.suffix else path.with_suffix(".png")  # instant-ngp's synthetic scenes leave it out


def _refuse_fisheye(entry: dict[str, Any], file: Path) -> None:
    model = entry.get("camera_model") or "OPENCV"
    if model not in _MODELS:
        raise InputError("camera_model", expected=" or ".join(_MODELS), got=model, file=file)
    for name in ("is_fisheye", "k4"):
        if entry.get(name):
            expected = "a pinhole with OpenCV's k1 k2 p1 p2 k3"
            raise InputError(name, expected=expected, got=entry[name], file=file)


def _lens(entry: dict[str, Any], picture: Path, file: Path) -> tuple[Lens, bytes]:
    _refuse_fisheye(entry, file)
    try:
        width, height = (int(entry["w"]), int(entry["h"])) if "w" in entry else sized(picture)
        fx = float(entry["fl_x"]) if "fl_x" in entry else 0.5 * width / np.tan(0.5 * float(entry["camera_angle_x"]))
        fy, cx, cy = (float(entry.get(k, d)) for k, d in (("fl_y", fx), ("cx", width / 2), ("cy", height / 2)))
        pose = np.linalg.inv(np.asarray(entry["transform_matrix"], np.float64).reshape(4, 4) @ _FLIP)
    except (KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise InputError(
            "frame", expected="fl_x or camera_angle_x, transform_matrix", got=repr(error), file=file
        ) from error
    bent = tuple(float(entry.get(k, 0)) for k in _BENT)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    camera = camera_of(K, pose[:3, :3], pose[:3, 3], (width, height), corner=0)
    return Lens(camera, bent if any(bent) else ()), camera.K.tobytes() + np.round(pose, 9).tobytes() + bytes(
        str(bent), "ascii"
    )


def _alpha(picture: Path):
    """The picture's own alpha, where it has one."""
    return partial(read_mask, picture) if len(read_header(picture).channels) == 4 else None
