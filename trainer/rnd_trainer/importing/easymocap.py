"""EasyMocap's and EasyVolcap's output: intri.yml, extri.yml, images/CAMERA, and SMPL fits."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.errors import InputError

from .pictures import beside, camera_of, listed, read_mask, read_rgb, sized
from .pose_files import read_poses
from .recording import Floats, Lens, Recording, Shot

FPS = 30.0
_FITS = (
    "output/smpl/smpl",
    "output-smpl-3d/smpl",
    "output/smpl",
    "output/smplfull",
    "smpl",
    "motion.npz",
    "params",
)
_MASKS = ("mask", "masks", "mask-schp", "mask_cihp", "segm")


def detect(source: Path) -> str | None:
    """ "intri.yml" and "extri.yml"."""
    return (
        "intri.yml and extri.yml" if all((source / f"{k}tri.yml").is_file() for k in ("in", "ex")) else None
    )


def read(source: Path, *, poses: Path | None = None, person: int | None = None) -> Recording:
    """Read OpenCV's calibration (pixel centres at whole numbers, metres), pictures and the fits of one person.

    ``poses``: any file of :func:`pose_files.read_poses`; looked for where EasyMocap (a folder of one JSON file a frame)
    and EasyVolcap (motion.npz) write it when not given.
    """
    fits = poses or next((source / name for name in _FITS if _is_fit(source / name)), None)
    if fits is None:
        raise InputError("SMPL fits", expected=" or ".join(_FITS) + ", or --poses", got="none", file=source)
    found = read_poses(fits, person=person)
    names = _names(source / "intri.yml")
    intrinsics, extrinsics = (
        cv2.FileStorage(str(source / f"{k}tri.yml"), cv2.FILE_STORAGE_READ) for k in ("in", "ex")
    )
    lenses, shots = {}, []
    for name in names:
        folder = source / "images" / name
        if not folder.is_dir():
            continue
        pictures = listed(folder)
        K, T = (
            _matrix(storage, key, source)
            for storage, key in ((intrinsics, f"K_{name}"), (extrinsics, f"T_{name}"))
        )
        R = extrinsics.getNode(f"Rot_{name}").mat()
        if R is None:
            R = cv2.Rodrigues(_matrix(extrinsics, f"R_{name}", source))[0]
        bent = next(
            (m for k in ("dist", "D") if (m := intrinsics.getNode(f"{k}_{name}").mat()) is not None),
            np.zeros(0),
        )
        size = sized(pictures[0])
        lenses[name] = Lens(
            camera_of(K, R, T, size), tuple(np.asarray(bent, np.float64).reshape(-1).tolist())
        )
        for picture in pictures:
            mask = beside(picture, *(source / part / name for part in _MASKS))
            read_it = None if mask is None else partial(read_mask, mask)
            shots.append(Shot(name, _number(picture), partial(read_rgb, picture), read_it))
    if not shots:
        raise InputError("pictures", expected=f"images/{names[0]}/*.jpg", got="none", file=source)
    return Recording("EasyMocap", lenses, shots, found.poses, found.fps or FPS, found.notes)


def _is_fit(path: Path) -> bool:
    return path.is_file() if path.suffix else path.is_dir() and any(path.glob("*.json"))


def _number(picture: Path) -> int:
    try:
        return int(picture.stem)
    except ValueError:
        raise InputError("picture name", expected="a frame number", got=picture.name, file=picture) from None


def _names(file: Path) -> list[str]:
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        node = storage.getNode("names")
        names = [node.at(k).string() for k in range(node.size())]
    except cv2.error as error:
        raise InputError(
            "calibration cannot be read", expected="OpenCV's YAML", got=str(error), file=file
        ) from error
    if not names:
        raise InputError("names", expected="the cameras' names", got="none", file=file)
    return names


def _matrix(storage: cv2.FileStorage, key: str, source: Path) -> Floats:
    matrix = storage.getNode(key).mat()
    if matrix is None:
        raise InputError("calibration", expected=key, got="none", file=source)
    return np.asarray(matrix, np.float64)
