"""ZJU-MoCap as released and as refined by Instant-NVR, and data sets that copy its layout (SyntheticHuman, H36M)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import Bytes, camera_of, distortion_of, find_beside, image_size, read_mask, read_rgb
from rnd_trainer.importing.poses import easymocap_poses

FPS = 50.0
_PARAMS = ("new_params", "smpl_params", "params")
_MASKS = ("mask", "mask_cihp")
_MILLIMETRES = 20.0
"""a camera farther from the origin than this many units is given in millimetres"""


def detect(source: Path) -> str | None:
    """ "annots.npy" with cameras and images, and a folder of SMPL parameters."""
    if not (source / "annots.npy").is_file():
        return None
    return f"annots.npy beside {_params_folder(source).name}/"


def read(source: Path) -> ImportedDataset:
    """Read ``annots.npy`` (K, D, R, T in mm; rows of image names) and one parameter file a frame.

    ``new_params`` before ``smpl_params`` before ``params``. Poses are EasyMocap's (Rh, Th). Masks of ``mask`` and
    ``mask_cihp`` are united, as either misses limbs.
    """
    file = source / "annots.npy"
    annots = read_pickle(file, what="annots")
    if not isinstance(annots, dict) or not {"cams", "ims"} <= annots.keys():
        raise InputError("annots.npy", expected="a dict with cams and ims", file=file)
    cams = annots["cams"]
    if not isinstance(cams, dict) or not set("KRTD") <= cams.keys():
        raise InputError("annots.npy", expected="cams with K, R, T and D", file=file)
    params = _params_folder(source)
    rows = [[str(name) for name in row["ims"]] for row in annots["ims"]]
    cameras = [Path(name).parent.name for name in rows[0]]
    samples, records = [], {}
    for row in rows:
        number = _frame_number(row[0])
        if not (params / f"{number}.npy").is_file():
            continue
        records[number] = _record(params / f"{number}.npy")
        for camera, name in zip(cameras, row):
            masks = _masks_of(source, Path(name))
            mask = partial(_union, masks) if masks else None
            samples.append(Sample(camera, number, partial(read_rgb, source / name), mask))
    if not samples:
        raise InputError("SMPL parameters", expected=f"{_frame_number(rows[0][0])}.npy, …", got="none", file=params)
    lenses = {}
    for k, camera in enumerate(cameras):
        T = np.asarray(cams["T"][k], np.float64).reshape(3)
        T = T / 1000 if np.linalg.norm(T) > _MILLIMETRES else T
        size = image_size(source / rows[0][k])
        lenses[camera] = Lens(camera_of(cams["K"][k], cams["R"][k], T, size), distortion_of(cams["D"][k]))
    frames = sorted(records)
    poses, Rh, Th, betas = (np.stack([records[n][key] for n in frames]) for key in ("poses", "Rh", "Th", "shapes"))
    notes: tuple[str, ...] = ()
    if params.name == "new_params":
        notes = ("new_params/: fitted with pose blend shapes, which our template lacks",)
    kind = "ZJU-MoCap" + (", refined" if (source / "images").is_dir() else "")
    return ImportedDataset(kind, lenses, samples, easymocap_poses(frames, poses, Rh, Th, betas), FPS, notes)


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
    record = {key: np.asarray(content[key], np.float64).reshape(-1) for key in sizes}
    for key, size in sizes.items():
        if size is not None and len(record[key]) != size:
            raise InputError(key, expected=f"{size} numbers", got=len(record[key]), file=file)
    return record


def _frame_number(image: str) -> int:
    """The number that an image and its parameters share; the fifth part of a name in CoreView_313 and 315."""
    parts = Path(image).stem.split("_")
    number = next((part for part in [*parts[4:5], *parts] if part.isdecimal()), None)
    if number is None:
        raise InputError("image name", expected="a frame number", got=image)
    return int(number)


def _masks_of(source: Path, image: Path) -> list[Path]:
    names = [image, Path(*image.parts[1:])] if image.parts[0] == "images" else [image]
    found = [find_beside(name, source / folder / name.parent) for folder in _MASKS for name in names]
    return [mask for mask in dict.fromkeys(found) if mask is not None]


def _union(masks: list[Path]) -> Bytes:
    result: Bytes = np.maximum.reduce([read_mask(mask) for mask in masks])
    return result
