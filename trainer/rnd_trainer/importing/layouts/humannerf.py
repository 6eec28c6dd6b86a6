"""HumanNeRF's layout (also GoMAvatar's): a camera and an EasyMocap pose per image."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    camera_of,
    distortion_of,
    find_beside,
    image_size,
    list_files,
    mask_reader,
    read_rgb,
)
from rnd_trainer.importing.poses import easymocap_poses

FPS = 30.0


def detect(source: Path) -> str | None:
    """ "cameras.pkl" beside "mesh_infos.pkl"."""
    needed = ("cameras.pkl", "mesh_infos.pkl")
    return " and ".join(needed) if all((source / name).is_file() for name in needed) else None


def read(source: Path) -> ImportedDataset:
    """Read one lens an image (equal ones are merged) and Rh, Th, poses by image name."""
    cameras, meshes = (read_pickle(source / name, what=name) for name in ("cameras.pkl", "mesh_infos.pkl"))
    if not isinstance(cameras, dict) or not isinstance(meshes, dict):
        raise InputError("cameras.pkl and mesh_infos.pkl", expected="dicts by image name", file=source)
    lenses: dict[str, Lens] = {}
    names: dict[bytes, str] = {}
    samples, fits = [], []
    for frame, image in enumerate(list_files(source / "images")):
        if image.stem not in cameras or image.stem not in meshes:
            continue
        entry = cameras[image.stem]
        K, pose = _numbers(entry, ("intrinsics", "extrinsics"), source / "cameras.pkl", frame)
        distortion = distortion_of(entry.get("distortions", ()))
        name = names.setdefault(K.tobytes() + pose.tobytes() + np.array(distortion).tobytes(), f"{len(names):04d}")
        if name not in lenses:
            pose = pose.reshape(4, 4)
            lenses[name] = Lens(camera_of(K, pose[:3, :3], pose[:3, 3], image_size(image)), distortion)
        mask = mask_reader(find_beside(image, source / "masks"))
        samples.append(Sample(name, frame, partial(read_rgb, image), mask, name=image.stem))
        fits.append((frame, _numbers(meshes[image.stem], ("poses", "Rh", "Th"), source / "mesh_infos.pkl", frame)))
    if not fits:
        raise InputError("images", expected="names that cameras.pkl and mesh_infos.pkl know", file=source)
    poses, Rh, Th = (np.stack([values[k] for _, values in fits]) for k in range(3))
    notes: tuple[str, ...] = ()
    betas = None
    if (source / "avg_betas.npy").is_file():
        betas = np.asarray(read_pickle(source / "avg_betas.npy", what="betas"), np.float64)
    else:
        notes = ("no avg_betas.npy: the mean shape is used",)
    body_poses = easymocap_poses([frame for frame, _ in fits], poses, Rh, Th, betas)
    return ImportedDataset("HumanNeRF", lenses, samples, body_poses, FPS, notes)


def _numbers(entry: Any, keys: tuple[str, ...], file: Path, frame: int) -> list[np.ndarray]:
    try:
        return [np.asarray(entry[key], np.float64).reshape(-1) for key in keys]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(file.name, expected=", ".join(keys), got=str(error), file=file, frame=frame) from error
