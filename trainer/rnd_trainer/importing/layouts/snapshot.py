"""PeopleSnapshot as its authors ship it: a video, its lens, masks and fitted poses."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import Bytes, camera_of, distortion_of, pinhole
from rnd_trainer.importing.poses import smpl_poses
from rnd_trainer.importing.videos.video_file import VideoFile


def detect(source: Path) -> str | None:
    """ "camera.pkl" beside "masks.hdf5" and "reconstructed_poses.hdf5"."""
    needed = ("camera.pkl", "masks.hdf5", "reconstructed_poses.hdf5")
    return ", ".join(needed) if all((source / name).is_file() for name in needed) else None


def read(source: Path) -> ImportedDataset:
    """Read the raw layout. Where there are more poses than masks, the last ones belong to the masks."""
    camera = read_pickle(source / "camera.pkl", what="camera")
    try:
        f, c, k, rt, t = (
            np.asarray(camera[f"camera_{key}"], np.float64).reshape(-1) for key in ("f", "c", "k", "rt", "t")
        )
        size = int(camera["width"]), int(camera["height"])
        K = pinhole(f[0], f[1], c[0], c[1])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        expected = "camera_f, _c, _k, _rt, _t, width, height"
        raise InputError("camera", expected=expected, file=source / "camera.pkl") from error
    lens = Lens(camera_of(K, axis_angle_to_matrix(rt), t, size), distortion_of(k))
    masks = _hdf5(source / "masks.hdf5", "masks")
    pose, trans, betas = (_hdf5(source / "reconstructed_poses.hdf5", key)[:] for key in ("pose", "trans", "betas"))
    count = len(masks)
    if len(pose) < count:
        raise InputError("poses", expected=f"one for each of {count} masks", got=len(pose), file=source)
    videos = sorted(source.glob("*.mp4"))
    if len(videos) != 1:
        raise InputError("video", expected="one .mp4", got=len(videos), file=source)
    video = VideoFile(videos[0])
    poses = smpl_poses(range(count), pose[-count:], trans[-count:], betas)
    frames = range(min(count, len(video.numbers)))
    samples = [Sample("0", k, partial(video.frame, k), partial(_mask, masks, k)) for k in frames]
    notes = (f"{len(pose)} poses for {count} masks: the last {count} used",) if len(pose) > count else ()
    return ImportedDataset("PeopleSnapshot", {"0": lens}, samples, poses, video.fps, notes)


def _mask(masks: Any, frame: int) -> Bytes:
    return np.where(np.asarray(masks[frame]) > 0, 255, 0).astype(np.uint8)


def _hdf5(path: Path, name: str) -> Any:
    need_packages("data", "h5py")
    import h5py

    try:
        return h5py.File(path, "r")[name]
    except (OSError, KeyError) as error:
        raise InputError(name, expected="a data set of an HDF5 file", got=str(error), file=path) from error
