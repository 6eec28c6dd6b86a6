"""RANA and SyntheticHuman as IntrinsicAvatar prepares them: cameras.json, poses.npz, masks as arrays, true normals."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import camera_of, distortion_of, list_files, mask_reader, read_json, read_rgb
from rnd_trainer.importing.poses import smpl_poses
from rnd_trainer.importing.surfaces.normals import read_normals

from .instant_avatar import find_mask, read_smpl_npz

FPS = 30.0
_OPENGL = np.array([1, -1, -1], np.float32)


def detect(source: Path) -> str | None:
    """ "cameras.json" with intrinsics beside "poses.npz"."""
    if not all((source / name).is_file() for name in ("cameras.json", "poses.npz")):
        return None
    record = read_json(source / "cameras.json")
    many = isinstance(record, dict) and "all_cam_names" in record
    if not many and not (isinstance(record, dict) and "intrinsic" in record):
        return None
    return "cameras.json and poses.npz, " + ("several cameras (SyntheticHuman)" if many else "one camera (RANA)")


def read(source: Path) -> ImportedDataset:
    """Read one camera (RANA) or several (SyntheticHuman); normals in OpenGL axes are flipped."""
    record = read_json(source / "cameras.json")
    names = [str(name) for name in record.get("all_cam_names", [])] or [""]
    axis_angles, trans, betas = read_smpl_npz(source / "poses.npz")
    lenses, samples = {}, []
    for name in names:
        camera = name or "0"
        lenses[camera] = _lens(record[name] if name else record, source / "cameras.json")
        images = list_files(source / "images" / name)
        if len(images) > len(axis_angles):
            expected = f"one for {images[len(axis_angles)].name}"
            raise InputError("poses", expected=expected, got=len(axis_angles), file=source / "poses.npz")
        for frame, image in enumerate(images):
            mask = mask_reader(find_mask(image, source / "masks" / name))
            normal = _find_normals(source, name, image)
            normals = None if normal is None else partial(opengl_normals, normal)
            samples.append(Sample(camera, frame, partial(read_rgb, image), mask, normals, name=image.stem))
    kind = "SyntheticHuman" if names != [""] else "RANA"
    poses = smpl_poses(np.arange(len(axis_angles)), axis_angles, trans, betas)
    return ImportedDataset(f"{kind} as IntrinsicAvatar prepares it", lenses, samples, poses, FPS)


def _lens(entry: dict[str, Any], file: Path) -> Lens:
    try:
        extrinsic = np.asarray(entry["extrinsic"], np.float64).reshape(4, 4)
        size = int(entry["width"]), int(entry["height"])
        camera = camera_of(entry["intrinsic"], extrinsic[:3, :3], extrinsic[:3, 3], size, corner=0)
        return Lens(camera, distortion_of(entry.get("distortion", ())))
    except (KeyError, ValueError) as error:
        expected = "intrinsic, extrinsic, width, height"
        raise InputError("camera", expected=expected, got=str(error), file=file) from error


def _find_normals(source: Path, folder: str, image: Path) -> Path | None:
    number = image.stem.split("_")[-1]
    for part in ("normals", "normals_png"):
        for stem in (f"normal_{number}", f"image_{number}", image.stem):
            if (file := source / part / folder / f"{stem}.png").is_file():
                return file
    return None


def opengl_normals(path: Path) -> NDArray[np.float32]:
    """A map of OpenGL's camera axes [H, W, 3] in OpenCV's."""
    flipped: NDArray[np.float32] = read_normals(path) * _OPENGL
    return flipped
