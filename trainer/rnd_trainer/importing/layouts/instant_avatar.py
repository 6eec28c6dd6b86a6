"""PeopleSnapshot as InstantAvatar ships it, and its users' own videos in the same layout."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import camera_of, find_beside, list_files, mask_reader, read_rgb
from rnd_trainer.importing.poses import Floats, Poses, smpl_poses

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


def read(source: Path) -> ImportedDataset:
    """Read a single static camera, whose frame is the world; images are undistorted."""
    with Npz(source / "cameras.npz", what="cameras") as archive:
        K, extrinsic = archive.numbers("intrinsic", (3, 3)), archive.numbers("extrinsic", (4, 4))
        size = int(archive.numbers("width").item()), int(archive.numbers("height").item())
    lens = Lens(camera_of(K, extrinsic[:3, :3], extrinsic[:3, 3], size))
    images = list_files(source / "images")
    subject = next((name for name in (source.name, source.resolve().name) if name in _SPLITS), None)
    split_of: dict[int, Split] = {}
    notes: tuple[str, ...] = ()
    if subject is not None and (source / "poses" / "anim_nerf_train.npz").is_file():
        poses, split_of = _optimised(source / "poses", subject)
        notes = ("poses: anim_nerf_*.npz, optimised, at InstantAvatar's own frames",)
    else:
        poses = _all_frames(source, len(images))
        if subject is None and any((source / "poses").glob("anim_nerf_*.npz")):
            known = ", ".join(_SPLITS)
            notes = (f"poses/anim_nerf_*.npz are left out: their frames are known for folders called {known}",)
    samples = []
    for frame, image in enumerate(images):
        if not split_of or frame in split_of:
            mask = mask_reader(find_mask(image, source / "masks"))
            split = split_of.get(frame)
            samples.append(Sample("0", frame, partial(read_rgb, image), mask, split=split, name=image.stem))
    names = {k: image.stem for k, image in enumerate(images)} if split_of else {}
    kind = "PeopleSnapshot as InstantAvatar ships it"
    return ImportedDataset(kind, {"0": lens}, samples, poses, FPS, notes, image_names=names)


def read_smpl_npz(path: Path) -> tuple[Floats, Floats, Floats | None]:
    """Axis-angles [F, 24, 3], trans [F, 3] and betas of thetas, or of global_orient and body_pose, with transl."""
    with Npz(path, what="poses") as archive:
        if "thetas" in archive.names:
            angles = archive.numbers("thetas", (None, 72))
        else:
            root, body = archive.numbers("global_orient").reshape(-1, 3), archive.numbers("body_pose")
            angles = np.concatenate([root, body.reshape(len(root), -1)], 1)
        trans = archive.numbers(archive.first_of("transl", "trans") or "transl", (len(angles), 3))
        betas = archive.numbers("betas") if "betas" in archive.names else None
    return angles.reshape(len(angles), -1, 3), trans, betas


def find_mask(image: Path, folder: Path) -> Path | None:
    """The mask called mask_NUMBER or like ``image`` in ``folder``."""
    number = image.stem.split("_")[-1]
    return find_beside(Path(f"mask_{number}"), folder) or find_beside(image, folder)


def _optimised(folder: Path, subject: str) -> tuple[Poses, dict[int, Split]]:
    """The poses of anim_nerf_*.npz, and the split of each of their frames."""
    split_of: dict[int, Split] = {}
    frames, rows = np.zeros(0, int), []
    for name, part in _SPLITS[subject].items():
        file = folder / f"anim_nerf_{name}.npz"
        if not file.is_file():
            continue
        rows.append(read_smpl_npz(file))
        if len(rows[-1][0]) != len(part):
            expected = f"{len(part)} in the {name} split of {subject}"
            raise InputError("frames", expected=expected, got=len(rows[-1][0]), file=file)
        frames = np.concatenate([frames, np.array(part)])
        split_of |= dict.fromkeys(part, "train" if name == "train" else "novel_pose")
    order = np.unique(frames, return_index=True)[1]
    angles, trans = (np.concatenate([row[k] for row in rows])[order] for k in (0, 1))
    return smpl_poses(frames[order], angles, trans, rows[0][2]), split_of


def _all_frames(source: Path, count: int) -> Poses:
    file = next((source / name for name in _POSES if (source / name).is_file()), source / _POSES[-1])
    axis_angles, trans, betas = read_smpl_npz(file)
    if len(axis_angles) < count:
        raise InputError("poses", expected=f"one for each of {count} images", got=len(axis_angles), file=file)
    return smpl_poses(np.arange(count), axis_angles[:count], trans[:count], betas)
