"""ZJU-MoCap as released and as refined by Instant-NVR, and data sets that copy its layout (SyntheticHuman, H36M)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.images import Bytes, beside, camera_of, read_mask, read_rgb, sized
from rnd_trainer.importing.recording import Lens, Recording, Shot, easymocap_poses

FPS = 50.0
"""of the ZJU-MoCap recordings"""
_PARAMS = ("new_params", "smpl_params", "params")
_MASKS = ("mask", "mask_cihp")
_MILLIMETRES = 20.0
"""a camera farther from the origin than this many units is given in millimetres"""


def detect(source: Path) -> str | None:
    """ "annots.npy" with cameras and pictures, and a folder of SMPL parameters."""
    if not (source / "annots.npy").is_file():
        return None
    return f"annots.npy beside {_params_folder(source).name}/"


def read(source: Path) -> Recording:
    """Read ``annots.npy`` (K, D, R, T in mm; rows of picture names) and one parameter file a frame.

    ``new_params`` before ``smpl_params`` before ``params``. Poses are EasyMocap's (Rh, Th). Masks of ``mask`` and
    ``mask_cihp`` are united, as either misses limbs.
    """
    annots = read_pickle(source / "annots.npy", what="annots")
    if not isinstance(annots, dict) or not {"cams", "ims"} <= annots.keys():
        raise InputError("annots.npy", expected="a dict with cams and ims", file=source / "annots.npy")
    cams = annots["cams"]
    if not isinstance(cams, dict) or not set("KRTD") <= cams.keys():
        raise InputError("annots.npy", expected="cams with K, R, T and D", file=source / "annots.npy")
    params = _params_folder(source)
    rows = [[str(name) for name in row["ims"]] for row in annots["ims"]]
    names = [_camera_name(name) for name in rows[0]]
    shots, numbers = [], {}
    for row in rows:
        number = _frame_number(row[0])
        file = params / f"{number}.npy"
        if not file.is_file():
            continue
        numbers[number] = file
        for camera, name in zip(names, row):
            picture = source / name
            masks = _masks_of(source, name)
            shots.append(Shot(camera, number, partial(read_rgb, picture), partial(_union, masks) if masks else None))
    if not shots:
        raise InputError("SMPL parameters", expected=f"{_frame_number(rows[0][0])}.npy, …", got="none", file=params)
    lenses = {}
    for k, camera in enumerate(names):
        T = np.asarray(cams["T"][k], np.float64).reshape(3)
        T = T / 1000 if np.linalg.norm(T) > _MILLIMETRES else T
        size = sized(source / rows[0][k])
        lenses[camera] = Lens(camera_of(cams["K"][k], cams["R"][k], T, size), _coefficients(cams["D"][k]))
    frames = sorted(numbers)
    records = [_record(numbers[number]) for number in frames]
    poses, Rh, Th, betas = (np.stack([r[key] for r in records]) for key in ("poses", "Rh", "Th", "shapes"))
    notes = (
        (f"{params.name}/: fitted with pose blend shapes, which our template has not",)
        if params.name == "new_params"
        else ()
    )
    kind = "ZJU-MoCap" + (", refined" if (source / "images").is_dir() else "")
    return Recording(kind, lenses, shots, easymocap_poses(frames, poses, Rh, Th, betas), FPS, notes)


def _params_folder(source: Path) -> Path:
    for name in _PARAMS:
        if (source / name).is_dir():
            return source / name
    raise InputError("SMPL parameters", expected=" or ".join(f"{name}/" for name in _PARAMS), got="none", file=source)


def _record(file: Path) -> dict[str, np.ndarray]:
    content = read_pickle(file, what="SMPL parameters")
    sizes = {"poses": 72, "Rh": 3, "Th": 3, "shapes": None}
    if not isinstance(content, dict) or not sizes.keys() <= content.keys():
        raise InputError("SMPL parameters", expected="a dict of poses, Rh, Th, shapes", file=file)
    record = {}
    for key, size in sizes.items():
        record[key] = np.asarray(content[key], np.float64).reshape(-1)
        if size is not None and len(record[key]) != size:
            raise InputError(key, expected=f"{size} numbers", got=len(record[key]), file=file)
    return record


def _camera_name(picture: str) -> str:
    return Path(picture).parent.name


def _frame_number(picture: str) -> int:
    """The number a picture and its parameters share; CoreView_313 and 315 hide it among other numbers."""
    parts = Path(picture).stem.split("_")
    candidates = [parts[4]] if len(parts) > 4 else []
    number = next((part for part in [*candidates, *parts] if part.isdecimal()), None)
    if number is None:
        raise InputError("picture name", expected="a frame number", got=picture)
    return int(number)


def _masks_of(source: Path, picture: str) -> list[Path]:
    inner = Path(picture)
    places = [inner, Path(*inner.parts[1:])] if inner.parts[0] == "images" else [inner]
    found = [beside(place, source / folder / place.parent) for folder in _MASKS for place in places]
    return [mask for mask in dict.fromkeys(found) if mask is not None]


def _union(masks: list[Path]) -> Bytes:
    result: Bytes = np.maximum.reduce([read_mask(mask) for mask in masks])
    return result


def _coefficients(D: Any) -> tuple[float, ...]:
    return tuple(np.asarray(D, np.float64).reshape(-1).tolist())
