"""PeopleSnapshot as InstantAvatar ships it, and its users' own videos in the same layout."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_trainer.importing.images import beside, camera_of, listed, read_mask, read_rgb
from rnd_trainer.importing.recording import Floats, Lens, Poses, Recording, Shot, smpl_poses

FPS = 30.0
_SPLITS: dict[str, dict[str, range]] = {
    "male-3-casual": {"train": range(0, 456, 4), "test": range(456, 676, 4)},
    "male-4-casual": {"train": range(0, 660, 6), "test": range(660, 873, 6)},
    "female-3-casual": {"train": range(0, 446, 4), "test": range(446, 648, 4)},
    "female-4-casual": {"train": range(0, 336, 4), "test": range(335, 524, 4)},
}
"""InstantAvatar's own frames of its four subjects; anim_nerf_*.npz hold one row for each"""
_POSES = ("poses_optimized.npz", "poses.npz")


def detect(source: Path) -> str | None:
    """ "cameras.npz" (intrinsic, extrinsic) and a poses file."""
    if (source / "cameras.npz").is_file() and (source / "images").is_dir():
        return "cameras.npz, images/ and SMPL poses in the camera's frame"
    return None


def read(source: Path) -> Recording:
    """Read a single static camera whose frame is the world; pictures are undistorted already."""
    with Npz(source / "cameras.npz", what="cameras") as archive:
        K, extrinsic = archive.numbers("intrinsic", (3, 3)), archive.numbers("extrinsic", (4, 4))
        size = int(archive.numbers("width").item()), int(archive.numbers("height").item())
    lens = Lens(camera_of(K, extrinsic[:3, :3], extrinsic[:3, 3], size))
    pictures = listed(source / "images")
    subject = next((name for name in (source.name, source.resolve().name) if name in _SPLITS), "")
    splits = _SPLITS.get(subject)
    optimised = splits is not None and (source / "poses" / "anim_nerf_train.npz").is_file()
    notes: tuple[str, ...] = ()
    split_of: dict[int, Split] = {}
    if optimised and splits is not None:
        parts = [(name, splits[name]) for name in splits if (source / "poses" / f"anim_nerf_{name}.npz").is_file()]
        frames, rows = np.zeros(0, int), []
        for name, part in parts:
            entry = read_smpl_npz(source / "poses" / f"anim_nerf_{name}.npz")
            if len(entry[0]) != len(part):
                raise InputError(
                    "frames",
                    expected=f"{len(part)} in the {name} split of {subject}",
                    got=len(entry[0]),
                    file=source / "poses" / f"anim_nerf_{name}.npz",
                )
            frames = np.concatenate([frames, np.array(part)])
            rows.append(entry)
            split_of |= dict.fromkeys(part, "train" if name == "train" else "novel_pose")
        order = np.unique(frames, return_index=True)[1]
        angles, trans = (np.concatenate([row[k] for row in rows])[order] for k in (0, 1))
        poses = smpl_poses(frames[order], angles, trans, rows[0][2])
        notes = ("poses: anim_nerf_*.npz, optimised, at InstantAvatar's own frames",)
    else:
        poses = _all_frames(source, len(pictures))
        if splits is None and any((source / "poses").glob("anim_nerf_*.npz")):
            known = ", ".join(_SPLITS)
            notes = (f"poses/anim_nerf_*.npz are left out: their frames are known for folders called {known}",)
    shots = []
    for frame, picture in enumerate(pictures):
        if split_of and frame not in split_of:
            continue
        mask = _mask_of(source, picture)
        read_it = None if mask is None else partial(read_mask, mask)
        image, split = partial(read_rgb, picture), split_of.get(frame)
        shots.append(Shot("0", frame, image, read_it, split=split, name=picture.stem))
    film = {k: picture.stem for k, picture in enumerate(pictures)} if split_of else {}
    return Recording("PeopleSnapshot as InstantAvatar ships it", {"0": lens}, shots, poses, FPS, notes, film=film)


def read_smpl_npz(path: Path) -> tuple[Floats, Floats, Floats | None]:
    """Axis-angles [F, 24, 3], trans [F, 3] and betas of thetas, or global_orient and body_pose, with transl."""
    with Npz(path, what="poses") as archive:
        if "thetas" in archive.names:
            angles = archive.numbers("thetas", (None, 72))
        else:
            root, body = archive.numbers("global_orient"), archive.numbers("body_pose")
            angles = np.concatenate([root.reshape(-1, 3), body.reshape(len(root.reshape(-1, 3)), -1)], 1)
        trans = archive.numbers(archive.first_of("transl", "trans") or "transl", (len(angles), 3))
        betas = archive.numbers("betas") if "betas" in archive.names else None
    return angles.reshape(len(angles), -1, 3), trans, betas


def _all_frames(source: Path, count: int) -> Poses:
    file = next((source / name for name in _POSES if (source / name).is_file()), source / _POSES[-1])
    axis_angles, trans, betas = read_smpl_npz(file)
    if len(axis_angles) < count:
        raise InputError("poses", expected=f"one for each of {count} pictures", got=len(axis_angles), file=file)
    return smpl_poses(np.arange(count), axis_angles[:count], trans[:count], betas)


def _mask_of(source: Path, picture: Path) -> Path | None:
    number = picture.stem.split("_")[-1]
    return beside(Path(f"mask_{number}.npy"), source / "masks") or beside(picture, source / "masks")
