"""RANA ("Relighting Humans") as its authors ship it: a JSON file beside every frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import Bytes, camera_of, image_size, pinhole, read_json, read_rgb
from rnd_trainer.importing.poses import Floats, Poses, mean_betas, smpl_poses

from .intrinsic_avatar import opengl_normals

FPS = 30.0
_HANDS_FROM = 57  # of body_pose: RANA's hands are not SMPL's, IntrinsicAvatar zeroes them


def detect(source: Path) -> str | None:
    """ "frame_000000.json" with "skeleton_0.smpl_data" beside the images."""
    first = next(iter(sorted(source.glob("frame_*.json"))), None)
    record = None if first is None else read_json(first)
    skeleton = record.get("skeleton_0") if isinstance(record, dict) else None
    if not isinstance(skeleton, dict) or "smpl_data" not in skeleton:
        return None
    return "frame_*.png with frame_*.json of smpl_data"


def read(source: Path) -> ImportedDataset:
    """Read images, masks (alpha of ``_semantic``), normals and poses; the camera's frame is the world.

    The root's position is global_trans / scale. The lens is smpl_data's K, or in the test set the horizontal field of
    view.
    """
    samples, positions, angles, frames = [], [], [], []
    betas, lens = None, None
    for file in sorted(source.glob("frame_*.json")):
        image = file.with_suffix(".png")
        frame = int(file.stem.split("_")[1])
        record = read_json(file)
        try:
            data = record["skeleton_0"]["smpl_data"]
            body = np.asarray(data["pose"], np.float64).reshape(-1).copy()
            body[_HANDS_FROM:] = 0
            angles.append(np.concatenate([np.asarray(data["global_orient"], np.float64).reshape(3), body]))
            scale = float(np.asarray(data["scale"]).reshape(-1)[0])
            positions.append(np.asarray(data["global_trans"], np.float64).reshape(3) / scale)
            betas = data["betas"]
            lens = lens or _lens(record, data, image_size(image))
        except (KeyError, TypeError, ValueError) as error:
            expected = "pose, global_orient, global_trans, scale, betas"
            raise InputError("smpl_data", expected=expected, got=str(error), file=file, frame=frame) from error
        frames.append(frame)
        mask = partial(_mask, image.with_name(f"{image.stem}_semantic.png"))
        normal = image.with_name(f"{image.stem}_normals.png")
        normals = partial(opengl_normals, normal) if normal.is_file() else None
        samples.append(Sample("0", frame, partial(read_rgb, image), mask, normals))
    assert lens is not None  # ``detect`` found a JSON file
    root = np.stack(positions)
    relative = smpl_poses(frames, np.stack(angles), root)
    poses = Poses(relative.frames, relative.rotations, lambda rest: root, relative.joint_names, betas=mean_betas(betas))
    return ImportedDataset("RANA", {"0": lens}, samples, poses, FPS, ("hands straightened: RANA's are not SMPL's",))


def _lens(record: dict[str, Any], data: dict[str, Any], size: tuple[int, int]) -> Lens:
    if "K" in data:
        K: Floats = np.asarray(data["K"], np.float64).reshape(3, 3)
    else:
        focal = 0.5 * size[0] / np.tan(0.5 * float(record["camera"]["fov"]))
        K = pinhole(focal, focal, size[0] / 2, size[1] / 2)
    return Lens(camera_of(K, np.eye(3), np.zeros(3), size, corner=0))


def _mask(path: Path) -> Bytes:
    return np.where(read_image(path)[..., -1] > 127, 255, 0).astype(np.uint8)
