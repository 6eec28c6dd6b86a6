"""EasyMocap's and EasyVolcap's output: intri.yml, extri.yml, images/CAMERA, and SMPL fits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.images import (
    camera_of,
    distortion_of,
    find_beside,
    frame_number,
    image_size,
    list_files,
    mask_reader,
    read_rgb,
)
from rnd_trainer.importing.opencv_yaml import Calibration
from rnd_trainer.importing.pose_files import pair_with_frames, poses_in_world, read_poses

FPS = 30.0
_FITS = ("output/smpl/smpl", "output-smpl-3d/smpl", "output/smpl", "output/smplfull", "smpl", "motion.npz", "params")
_MASKS = ("mask", "masks", "mask-schp", "mask_cihp", "segm")


def detect(source: Path) -> str | None:
    """ "intri.yml" and "extri.yml"."""
    return "intri.yml and extri.yml" if all((source / f"{k}tri.yml").is_file() for k in ("in", "ex")) else None


def read(source: Path, *, poses: Path | None = None, person: int | None = None) -> ImportedDataset:
    """Read OpenCV's calibration (pixel centres at whole numbers, m), images and the fits of one person.

    ``poses`` is any file of ``pose_files.read_poses``. Default: where EasyMocap (one JSON file a frame) or EasyVolcap
    (motion.npz) writes it. Poses in numbered files belong to the images of those numbers, those in one file to the
    images in their order.
    """
    fits = poses or next((source / name for name in _FITS if _is_fit(source / name)), None)
    if fits is None:
        raise InputError("SMPL fits", expected=" or ".join(_FITS) + ", or --poses", got="none", file=source)
    found = read_poses(fits, person=person)
    intrinsics, extrinsics = (Calibration(source / f"{k}tri.yml") for k in ("in", "ex"))
    names = intrinsics.strings("names")
    if not names:
        raise InputError("names", expected="the cameras' names", got="none", file=source / "intri.yml")
    lenses, samples = {}, []
    for name in names:
        folder = source / "images" / name
        if not folder.is_dir():
            continue
        images = list_files(folder)
        lenses[name] = _lens(intrinsics, extrinsics, name, image_size(images[0]))
        for image in images:
            mask = mask_reader(find_beside(image, *(source / part / name for part in _MASKS)))
            samples.append(Sample(name, frame_number(image), partial(read_rgb, image), mask, name=image.stem))
    if not samples:
        raise InputError("images", expected=f"images/{names[0]}/*.jpg", got="none", file=source)
    found = replace(found, poses=poses_in_world(found, list(lenses.values()), source))
    numbers = sorted({sample.frame for sample in samples})
    if not found.numbered:
        order = {number: k for k, number in enumerate(numbers)}
        samples = [replace(sample, frame=order[sample.frame]) for sample in samples]
        numbers = list(order.values())
    body_poses, notes = pair_with_frames(found, numbers, source)
    return ImportedDataset("EasyMocap", lenses, samples, body_poses, found.fps or FPS, (*found.notes, *notes))


def _lens(intrinsics: Calibration, extrinsics: Calibration, name: str, size: tuple[int, int]) -> Lens:
    R = extrinsics.optional_matrix(f"Rot_{name}")
    if R is None:
        R = axis_angle_to_matrix(extrinsics.matrix(f"R_{name}").reshape(-1))
    camera = camera_of(intrinsics.matrix(f"K_{name}"), R, extrinsics.matrix(f"T_{name}"), size)
    for key in ("dist", "D"):
        if (coefficients := intrinsics.optional_matrix(f"{key}_{name}")) is not None:
            return Lens(camera, distortion_of(coefficients))
    return Lens(camera)


def _is_fit(path: Path) -> bool:
    return path.is_file() if path.suffix else path.is_dir() and any(path.glob("*.json"))
