"""EasyMocap's and EasyVolcap's output: intri.yml, extri.yml, images/CAMERA, and SMPL fits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.images import beside, camera_of, listed, read_mask, read_rgb, sized
from rnd_trainer.importing.pose_files import before_cameras, paired, read_poses
from rnd_trainer.importing.recording import Floats, Lens, Recording, Shot

FPS = 30.0
_FITS = ("output/smpl/smpl", "output-smpl-3d/smpl", "output/smpl", "output/smplfull", "smpl", "motion.npz", "params")
_MASKS = ("mask", "masks", "mask-schp", "mask_cihp", "segm")


def detect(source: Path) -> str | None:
    """ "intri.yml" and "extri.yml"."""
    return "intri.yml and extri.yml" if all((source / f"{k}tri.yml").is_file() for k in ("in", "ex")) else None


def read(source: Path, *, poses: Path | None = None, person: int | None = None) -> Recording:
    """Read OpenCV's calibration (pixel centres at whole numbers, metres), pictures and the fits of one person.

    ``poses``: any file of ``pose_files.read_poses``; looked for where EasyMocap (a folder of one JSON file a frame)
    and EasyVolcap (motion.npz) write it when not given. Poses in numbered files belong to the pictures of those
    numbers, those in one file to the pictures in their order.
    """
    fits = poses or next((source / name for name in _FITS if _is_fit(source / name)), None)
    if fits is None:
        raise InputError("SMPL fits", expected=" or ".join(_FITS) + ", or --poses", got="none", file=source)
    found = read_poses(fits, person=person)
    names = _names(source / "intri.yml")
    intrinsics, extrinsics = (_opened(source / f"{k}tri.yml") for k in ("in", "ex"))
    lenses, shots = {}, []
    for name in names:
        folder = source / "images" / name
        if not folder.is_dir():
            continue
        pictures = listed(folder)
        K, T = (
            _matrix(storage, key, source) for storage, key in ((intrinsics, f"K_{name}"), (extrinsics, f"T_{name}"))
        )
        R = _found(extrinsics, f"Rot_{name}", source)
        if R is None:
            R = cv2.Rodrigues(_matrix(extrinsics, f"R_{name}", source))[0]
        bent = next(
            (m for k in ("dist", "D") if (m := _found(intrinsics, f"{k}_{name}", source)) is not None), np.zeros(0)
        )
        lenses[name] = Lens(camera_of(K, R, T, sized(pictures[0])), tuple(bent.reshape(-1).tolist()))
        for picture in pictures:
            mask = beside(picture, *(source / part / name for part in _MASKS))
            read_it = None if mask is None else partial(read_mask, mask)
            shots.append(Shot(name, _number(picture), partial(read_rgb, picture), read_it, name=picture.stem))
    if not shots:
        raise InputError("pictures", expected=f"images/{names[0]}/*.jpg", got="none", file=source)
    found = replace(found, poses=before_cameras(found, list(lenses.values()), source))
    numbers = sorted({shot.frame for shot in shots})
    if not found.numbered:
        place = {number: k for k, number in enumerate(numbers)}
        shots = [replace(shot, frame=place[shot.frame]) for shot in shots]
        numbers = list(place.values())
    body_poses, counted = paired(found, numbers, source)
    return Recording("EasyMocap", lenses, shots, body_poses, found.fps or FPS, (*found.notes, *counted))


def _is_fit(path: Path) -> bool:
    return path.is_file() if path.suffix else path.is_dir() and any(path.glob("*.json"))


def _number(picture: Path) -> int:
    try:
        return int(picture.stem)
    except ValueError:
        raise InputError("picture name", expected="a frame number", got=picture.name, file=picture) from None


def _names(file: Path) -> list[str]:
    storage = _opened(file)
    node = storage.getNode("names")
    names = [node.at(k).string() for k in range(node.size())] if node.isSeq() else []
    if not names:
        raise InputError("names", expected="the cameras' names", got="none", file=file)
    return names


def _opened(file: Path) -> cv2.FileStorage:
    try:
        return cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise InputError(
            "calibration cannot be read", expected="OpenCV's YAML", got="another text", file=file
        ) from error


def _matrix(storage: cv2.FileStorage, key: str, source: Path) -> Floats:
    matrix = _found(storage, key, source)
    if matrix is None:
        raise InputError("calibration", expected=key, got="none", file=source)
    return matrix


def _found(storage: cv2.FileStorage, key: str, source: Path) -> Floats | None:
    try:
        matrix = storage.getNode(key).mat()
    except cv2.error as error:
        raise InputError("calibration", expected=f"{key}, a matrix", got="a damaged one", file=source) from error
    return None if matrix is None else np.asarray(matrix, np.float64)
