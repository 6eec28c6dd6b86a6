"""RANA and SyntheticHuman as IntrinsicAvatar prepares them: cameras.json, poses.npz, masks as arrays, true normals."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.images import beside, camera_of, listed, read_json, read_mask, read_rgb
from rnd_trainer.importing.recording import Lens, Recording, Shot, smpl_poses
from rnd_trainer.importing.surfaces.normals import read_normals

from .instant_avatar import read_smpl_npz

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


def read(source: Path) -> Recording:
    """Read one camera (RANA) or several (SyntheticHuman); normals are OpenGL's and are turned."""
    record = read_json(source / "cameras.json")
    names = [str(name) for name in record.get("all_cam_names", [])] or [""]
    axis_angles, trans, betas = read_smpl_npz(source / "poses.npz")
    lenses, shots = {}, []
    for name in names:
        entry = record[name] if name else record
        camera = name or "0"
        lenses[camera] = _lens(entry, source)
        for frame, picture in enumerate(listed(source / "images" / name)):
            if frame >= len(axis_angles):
                raise InputError(
                    "poses", expected=f"one for {picture.name}", got=len(axis_angles), file=source / "poses.npz"
                )
            shots.append(_shot(source, camera, name, frame, picture))
    kind = "SyntheticHuman" if names != [""] else "RANA"
    poses = smpl_poses(np.arange(len(axis_angles)), axis_angles, trans, betas)
    return Recording(f"{kind} as IntrinsicAvatar prepares it", lenses, shots, poses, FPS)


def _lens(entry: dict[str, Any], source: Path) -> Lens:
    try:
        extrinsic = np.asarray(entry["extrinsic"], np.float64).reshape(4, 4)
        size = int(entry["width"]), int(entry["height"])
        camera = camera_of(entry["intrinsic"], extrinsic[:3, :3], extrinsic[:3, 3], size, corner=0)
        return Lens(camera, tuple(np.asarray(entry.get("distortion", ()), np.float64).reshape(-1).tolist()))
    except (KeyError, ValueError) as error:
        raise InputError(
            "camera", expected="intrinsic, extrinsic, width, height", got=str(error), file=source / "cameras.json"
        ) from error


def _shot(source: Path, camera: str, folder: str, frame: int, picture: Path) -> Shot:
    number = picture.stem.split("_")[-1]
    mask = beside(Path(f"mask_{number}"), source / "masks" / folder) or beside(picture, source / "masks" / folder)
    normal = next(
        (
            file
            for part in ("normals", "normals_png")
            for stem in (f"normal_{number}", f"image_{number}", picture.stem)
            if (file := source / part / folder / f"{stem}.png").is_file()
        ),
        None,
    )
    return Shot(
        camera,
        frame,
        partial(read_rgb, picture),
        None if mask is None else partial(read_mask, mask),
        None if normal is None else partial(opengl_normals, normal),
        name=picture.stem,
    )


def opengl_normals(path: Path) -> NDArray[np.float32]:
    """A map of OpenGL's camera axes [H, W, 3] in OpenCV's."""
    turned: NDArray[np.float32] = read_normals(path) * _OPENGL
    return turned
