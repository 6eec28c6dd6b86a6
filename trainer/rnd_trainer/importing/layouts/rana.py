"""RANA ("Relighting Humans") as its authors ship it: a JSON file beside every frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_trainer.importing.images import Bytes, camera_of, read_json, read_rgb, sized
from rnd_trainer.importing.recording import Floats, Lens, Poses, Recording, Shot, mean_betas, smpl_poses

from .intrinsic_avatar import opengl_normals

FPS = 30.0
_HANDS_FROM = 57  # of body_pose: RANA's hands are not SMPL's, IntrinsicAvatar zeroes them


def detect(source: Path) -> str | None:
    """ "frame_000000.json" with "skeleton_0.smpl_data" beside the pictures."""
    first = next(iter(sorted(source.glob("frame_*.json"))), None)
    record = None if first is None else read_json(first)
    skeleton = record.get("skeleton_0") if isinstance(record, dict) else None
    if not isinstance(skeleton, dict) or "smpl_data" not in skeleton:
        return None
    return "frame_*.png with frame_*.json of smpl_data"


def read(source: Path) -> Recording:
    """Read pictures, masks (alpha of ``_semantic``), normals and poses; the camera's frame is the world.

    The root lies at global_trans / scale. The lens is smpl_data's K, or in the test set the horizontal field of view.
    """
    shots, roots, angles, frames = [], [], [], []
    betas, lens = None, None
    for file in sorted(source.glob("frame_*.json")):
        picture = file.with_suffix(".png")
        frame = int(file.stem.split("_")[1])
        record = read_json(file)
        try:
            data = record["skeleton_0"]["smpl_data"]
            body = np.asarray(data["pose"], np.float64).reshape(-1).copy()
            body[_HANDS_FROM:] = 0
            angles.append(np.concatenate([np.asarray(data["global_orient"], np.float64).reshape(3), body]))
            scale = float(np.asarray(data["scale"]).reshape(-1)[0])
            roots.append(np.asarray(data["global_trans"], np.float64).reshape(3) / scale)
            betas = data["betas"]
            lens = lens or Lens(
                camera_of(_K(record, data, sized(picture)), np.eye(3), np.zeros(3), sized(picture), corner=0)
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                "smpl_data",
                expected="pose, global_orient, global_trans, scale, betas",
                got=str(error),
                file=file,
                frame=frame,
            ) from error
        frames.append(frame)
        stem = picture.with_suffix("")
        shots.append(
            Shot(
                "0",
                frame,
                partial(read_rgb, picture),
                partial(_mask, Path(f"{stem}_semantic.png")),
                partial(opengl_normals, n) if (n := Path(f"{stem}_normals.png")).is_file() else None,
            )
        )
    assert lens is not None  # detected by a JSON file
    places = np.stack(roots)
    turned = smpl_poses(frames, np.stack(angles), places)

    def root(rest: Floats) -> Floats:
        return places

    poses = Poses(turned.frames, turned.rotations, root, turned.joint_names, betas=mean_betas(betas))
    return Recording("RANA", {"0": lens}, shots, poses, FPS, ("hands straightened: RANA's are not SMPL's",))


def _K(record: dict[str, Any], data: dict[str, Any], size: tuple[int, int]) -> Floats:
    if "K" in data:
        return np.asarray(data["K"], np.float64).reshape(3, 3)
    focal = 0.5 * size[0] / np.tan(0.5 * float(record["camera"]["fov"]))
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])


def _mask(path: Path) -> Bytes:
    pixels = read_image(path)
    return np.where(pixels[..., -1] > 127, 255, 0).astype(np.uint8)
