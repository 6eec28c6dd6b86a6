"""NeuMan: one moving camera by COLMAP, of unknown scale, and SMPL fits aligned to it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    Bytes,
    camera_of,
    find_beside,
    frame_number,
    mask_reader,
    nearest_rotation,
    read_mask,
    read_rgb,
)
from rnd_trainer.importing.poses import Floats, Poses, mean_betas

from .colmap import ColmapImage, read_text_model

FPS = 30.0
_FITS = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")
_HUGS = Path("4d_humans") / "smpl_optimized_aligned_scale.npz"


class _Fits(NamedTuple):
    """Fits x = scale · rotation · smpl(pose) + shift in COLMAP's world, one row an image."""

    rotations: Floats  # [F, 3, 3]
    scales: Floats  # [F]
    shifts: Floats  # [F, 3]
    angles: Floats  # [F, J, 3] rad
    betas: Floats  # [B] or [F, B]


def detect(source: Path) -> str | None:
    """ "sparse/" in text, and "alignments.npy" or HUGS' "4d_humans"."""
    if not (source / "sparse" / "images.txt").is_file():
        return None
    for name in ("alignments.npy", str(_HUGS)):
        if (source / name).is_file():
            return f"sparse/ and {name}"
    return None


def read(source: Path) -> ImportedDataset:
    """Read COLMAP's cameras and the SMPL fits; COLMAP's unit becomes a metre by the fits' median scale.

    A fit's deviation from the median scale moves the person along the viewing ray.
    HUGS' fits (``4d_humans``) before NeuMan's optimised ones before ROMP's.
    """
    images = sorted(read_text_model(source / "sparse"), key=lambda image: image.name)
    frames = np.array([frame_number(Path(image.name)) for image in images])
    hugs = (source / _HUGS).is_file()
    fits = _hugs_fits(source / _HUGS, len(images)) if hugs else _neuman_fits(source, images, frames)
    metre = float(np.median(fits.scales))
    lenses, samples = {}, []
    splits = _splits(len(images))
    sam = sorted((source / "4d_humans" / "sam_segmentations").glob("*.png")) if hugs else []
    for k, (image, frame) in enumerate(zip(images, frames)):
        name = f"{frame:05d}"
        lenses[name] = Lens(camera_of(image.K, image.R, image.t / metre, image.size, corner=0), image.distortion)
        file = source / "images" / image.name
        mask = mask_reader(sam[k]) if len(sam) == len(images) else _inverted_reader(source, file)
        samples.append(Sample(name, int(frame), partial(read_rgb, file), mask, split=splits[k], name=file.stem))
    rotations = axis_angle_to_matrix(fits.angles)
    rotations[:, 0] = fits.rotations @ rotations[:, 0]

    def root(rest: Floats) -> Floats:
        """Root positions in metres: each camera's own coordinates divided by the fit's scale."""
        positions = np.empty((len(images), 3))
        for k, image in enumerate(images):
            world = fits.scales[k] * fits.rotations[k] @ rest + fits.shifts[k]  # SMPL's root rotates about the pelvis
            local = (image.R @ world + image.t) / fits.scales[k]
            positions[k] = image.R.T @ (local - image.t / metre)
        return positions

    notes = (f"COLMAP's unit is {1 / metre:.4g} m by the fits", "HUGS' fits" if hugs else "NeuMan's own fits")
    poses = Poses(frames, rotations, root, betas=mean_betas(fits.betas))
    return ImportedDataset("NeuMan", lenses, samples, poses, FPS, notes)


def _neuman_fits(source: Path, images: list[ColmapImage], frames: np.ndarray) -> _Fits:
    """Fits of ``alignments.npy`` and the SMPL output: x = [v, 1] · alignment (4×3)."""
    alignments = read_pickle(source / "alignments.npy", what="alignments")
    file = next((source / name for name in _FITS if (source / name).is_file()), source / _FITS[0])
    people = read_pickle(file, what="SMPL fits")
    if not isinstance(people, dict) or not people:
        raise InputError("SMPL fits", expected="a dict by person", got=type(people).__name__, file=file)
    person = next(iter(people.values()))
    pose, betas = np.asarray(person["pose"], np.float64), np.asarray(person["betas"], np.float64)
    if frames.max() >= len(pose):
        raise InputError("SMPL fits", expected=f"more than {frames.max()} frames", got=len(pose), file=file)
    rotations, scales, shifts = [], [], []
    for image, frame in zip(images, frames):
        if image.name not in alignments:
            file = source / "alignments.npy"
            raise InputError("alignment", expected=image.name, got="none", file=file, frame=int(frame))
        matrix = np.asarray(alignments[image.name], np.float64)[:4, :3]
        linear = matrix[:3].T
        scales.append(float(np.cbrt(np.linalg.det(linear))))
        rotations.append(nearest_rotation(linear / scales[-1]))
        shifts.append(matrix[3])
    angles = pose[frames].reshape(len(frames), -1, 3)
    return _Fits(np.stack(rotations), np.array(scales), np.stack(shifts), angles, betas)


def _hugs_fits(file: Path, count: int) -> _Fits:
    """Fits of HUGS: x = scale · smpl(pose) + transl."""
    with Npz(file, what="SMPL fits") as archive:
        root, body = archive.numbers("global_orient").reshape(-1, 3), archive.numbers("body_pose")
        if len(root) != count:
            raise InputError("SMPL fits", expected=f"{count} rows, one an image", got=len(root), file=file)
        angles = np.concatenate([root, body.reshape(count, -1)], 1).reshape(count, -1, 3)
        scales = np.broadcast_to(archive.numbers("scale").reshape(-1), (count,))
        eye = np.broadcast_to(np.eye(3), (count, 3, 3))
        return _Fits(eye, scales, archive.numbers("transl", (count, 3)), angles, archive.numbers("betas"))


def _splits(count: int) -> list[Split]:
    """NeuMan's splits: held-out frames at a constant interval, from half an interval on."""
    held = range(count)[max(1, count // max(1, count // 5)) // 2 :: max(1, count // max(1, count // 5))]
    return ["novel_pose" if k in held else "train" for k in range(count)]


def _inverted_reader(source: Path, image: Path):
    """Reader of NeuMan's masks, which are 255 in the background."""
    file = find_beside(image, source / "segmentations")
    return None if file is None else partial(_inverted, file)


def _inverted(path: Path) -> Bytes:
    return (255 - np.where(read_mask(path) == 255, 255, 0)).astype(np.uint8)
