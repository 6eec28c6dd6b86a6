"""ARAH's layout (also 3DGS-Avatar's): cam_params.json, a folder of images a camera, a model file a frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    camera_of,
    distortion_of,
    frame_number,
    image_size,
    list_files,
    mask_reader,
    read_json,
    read_rgb,
)
from rnd_trainer.importing.poses import Poses, smpl_poses

FPS = 50.0
_MODELS = ("opt_models", "models")


def detect(source: Path) -> str | None:
    """ "cam_params.json" beside "models"."""
    if (source / "cam_params.json").is_file() and any((source / name).is_dir() for name in _MODELS):
        return "cam_params.json and models/*.npz"
    return None


def read(source: Path) -> ImportedDataset:
    """Read SMPL poses (root_orient, trans) and K, D, R, T (m) of each camera.

    ``opt_models`` come before ``models``. Masks are the PNG beside the JPEG. Files are named by frame number.
    """
    poses = _poses(next(source / name for name in _MODELS if (source / name).is_dir()))
    known = set(poses.frames.tolist())
    file = source / "cam_params.json"
    record = read_json(file)
    if not isinstance(record, dict):
        raise InputError("cameras", expected="a dict by name", got=type(record).__name__, file=file)
    lenses, samples = {}, []
    for name in map(str, record.get("all_cam_names", [])):
        if not (source / name).is_dir() or name not in record:
            continue
        images = list_files(source / name, (".jpg", ".jpeg"))
        K, D, R, T = (record[name][key] for key in "KDRT")
        lenses[name] = Lens(camera_of(K, R, T, image_size(images[0])), distortion_of(D))
        for image in images:
            mask, number = image.with_suffix(".png"), frame_number(image)
            if number in known:
                mask_file = mask if mask.is_file() else None
                samples.append(Sample(name, number, partial(read_rgb, image), mask_reader(mask_file)))
    if not lenses:
        raise InputError("cameras", expected="all_cam_names with a folder each", got="none", file=file)
    return ImportedDataset("ARAH / 3DGS-Avatar", lenses, samples, poses, FPS)


def _poses(folder: Path) -> Poses:
    frames, angles, trans, betas = [], [], [], None
    for file in sorted(list_files(folder, (".npz",)), key=frame_number):
        with Npz(file, what="model") as archive:
            parts = [
                archive.numbers(*part) for part in (("root_orient", (3,)), ("pose_body", (63,)), ("pose_hand", (6,)))
            ]
            angles.append(np.concatenate(parts))
            trans.append(archive.numbers("trans").reshape(3))
            betas = archive.numbers("betas") if "betas" in archive.names else betas
        frames.append(frame_number(file))
    return smpl_poses(frames, angles, trans, betas)
