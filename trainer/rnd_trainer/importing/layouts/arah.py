"""ARAH's layout (also 3DGS-Avatar's): cam_params.json, a folder of pictures a camera, a model file a frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_trainer.importing.images import camera_of, listed, read_json, read_mask, read_rgb, sized
from rnd_trainer.importing.recording import Lens, Recording, Shot, smpl_poses

FPS = 50.0
_MODELS = ("opt_models", "models")


def detect(source: Path) -> str | None:
    """ "cam_params.json" beside "models"."""
    if (source / "cam_params.json").is_file() and any((source / name).is_dir() for name in _MODELS):
        return "cam_params.json and models/*.npz"
    return None


def read(source: Path) -> Recording:
    """Read poses in SMPL's convention (root_orient, trans) and K, D, R, T (metres) of each camera.

    ``opt_models`` before ``models``. Masks lie beside the pictures, as PNG beside JPEG. Frame numbers name
    the files.
    """
    models = next(source / name for name in _MODELS if (source / name).is_dir())
    files = sorted(listed(models, (".npz",)), key=_number)
    frames, angles, trans, betas = [], [], [], None
    for file in files:
        with Npz(file, what="model") as archive:
            parts = [
                archive.numbers(name, (size,))
                for name, size in (("root_orient", 3), ("pose_body", 63), ("pose_hand", 6))
            ]
            angles.append(np.concatenate(parts))
            trans.append(archive.numbers("trans").reshape(3))
            betas = archive.numbers("betas") if "betas" in archive.names else betas
        frames.append(_number(file))
    record = read_json(source / "cam_params.json")
    if not isinstance(record, dict):
        got = type(record).__name__
        raise InputError("cameras", expected="a dict by name", got=got, file=source / "cam_params.json")
    lenses, shots = {}, []
    for name in record.get("all_cam_names", []):
        folder = source / str(name)
        if not folder.is_dir() or str(name) not in record:
            continue
        pictures = listed(folder, (".jpg", ".jpeg"))
        entry = record[str(name)]
        lenses[str(name)] = Lens(
            camera_of(entry["K"], entry["R"], entry["T"], sized(pictures[0])),
            tuple(np.asarray(entry["D"], np.float64).reshape(-1).tolist()),
        )
        known = set(frames)
        for picture in pictures:
            mask, number = picture.with_suffix(".png"), _number(picture)
            if number in known:
                read_it = partial(read_mask, mask) if mask.is_file() else None
                shots.append(Shot(str(name), number, partial(read_rgb, picture), read_it))
    if not lenses:
        raise InputError(
            "cameras", expected="all_cam_names with a folder each", got="none", file=source / "cam_params.json"
        )
    return Recording("ARAH / 3DGS-Avatar", lenses, shots, smpl_poses(frames, angles, trans, betas), FPS)


def _number(file: Path) -> int:
    if not file.stem.isdecimal():
        raise InputError("file name", expected="a frame number", got=file.name, file=file)
    return int(file.stem)
