"""HumanNeRF's layout (also GoMAvatar's): pictures in a row, a camera and an EasyMocap pose for each."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.images import beside, camera_of, listed, read_mask, read_rgb, sized
from rnd_trainer.importing.recording import Lens, Recording, Shot, easymocap_poses

FPS = 30.0


def detect(source: Path) -> str | None:
    """ "cameras.pkl" beside "mesh_infos.pkl"."""
    needed = ("cameras.pkl", "mesh_infos.pkl")
    return " and ".join(needed) if all((source / name).is_file() for name in needed) else None


def read(source: Path) -> Recording:
    """Read one lens a picture (equal ones are merged) and Rh, Th, poses of the picture's name."""
    cameras, meshes = (read_pickle(source / name, what=name) for name in ("cameras.pkl", "mesh_infos.pkl"))
    if not isinstance(cameras, dict) or not isinstance(meshes, dict):
        raise InputError("cameras.pkl and mesh_infos.pkl", expected="dicts by picture name", file=source)
    lenses: dict[str, Lens] = {}
    names: dict[bytes, str] = {}
    shots, kept = [], []
    for frame, picture in enumerate(listed(source / "images")):
        if picture.stem not in cameras or picture.stem not in meshes:
            continue
        entry = cameras[picture.stem]
        values = _numbers(entry, ("intrinsics", "extrinsics"), source / "cameras.pkl", frame)
        bent = np.asarray(entry["distortions"], np.float64).reshape(-1) if "distortions" in entry else np.zeros(0)
        key = b"".join(value.tobytes() for value in (*values, bent))
        if key not in names:
            names[key] = f"{len(names):04d}"
            K, pose = values[0].reshape(3, 3), values[1].reshape(4, 4)
            lens = Lens(camera_of(K, pose[:3, :3], pose[:3, 3], sized(picture)), tuple(bent.tolist()))
            lenses[names[key]] = lens
        mask = beside(picture, source / "masks")
        read_it = None if mask is None else partial(read_mask, mask)
        shots.append(Shot(names[key], frame, partial(read_rgb, picture), read_it, name=picture.stem))
        kept.append((frame, _numbers(meshes[picture.stem], ("poses", "Rh", "Th"), source / "mesh_infos.pkl", frame)))
    if not kept:
        raise InputError("pictures", expected="names that cameras.pkl and mesh_infos.pkl know", file=source)
    poses, Rh, Th = (np.stack([values[k] for _, values in kept]) for k in range(3))
    notes: tuple[str, ...] = ()
    betas = None
    if (source / "avg_betas.npy").is_file():
        betas = np.asarray(read_pickle(source / "avg_betas.npy", what="betas"), np.float64)
    else:
        notes = ("no avg_betas.npy: the mean shape is used",)
    return Recording(
        "HumanNeRF", lenses, shots, easymocap_poses([f for f, _ in kept], poses, Rh, Th, betas), FPS, notes
    )


def _numbers(entry: Any, keys: tuple[str, ...], file: Path, frame: int) -> list[np.ndarray]:
    try:
        return [np.asarray(entry[key], np.float64).reshape(-1) for key in keys]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(file.name, expected=", ".join(keys), got=str(error), file=file, frame=frame) from error
