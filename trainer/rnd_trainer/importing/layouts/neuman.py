"""NeuMan: one moving camera, solved by COLMAP in a world without metres, and SMPL fits aligned to it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_trainer.importing.images import Bytes, beside, camera_of, nearest_rotation, read_mask, read_rgb
from rnd_trainer.importing.recording import Floats, Lens, Poses, Recording, Shot, mean_betas

from .colmap import Posed, read_text_model

FPS = 30.0
_FITS = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")
_HUGS = Path("4d_humans") / "smpl_optimized_aligned_scale.npz"


def detect(source: Path) -> str | None:
    """ "sparse/" in text, and "alignments.npy" or HUGS' "4d_humans"."""
    if not (source / "sparse" / "images.txt").is_file():
        return None
    for name in ("alignments.npy", str(_HUGS)):
        if (source / name).is_file():
            return f"sparse/ and {name}"
    return None


def read(source: Path) -> Recording:
    """Read COLMAP's cameras and the SMPL fits; COLMAP's unit becomes a metre by the fits' median scale.

    A fit's own scale, where it differs from the median, moves the person along the ray: the picture is the same.
    HUGS' fits (``4d_humans``) before NeuMan's optimised ones before ROMP's.
    """
    posed = read_text_model(source / "sparse")
    posed = sorted(posed, key=lambda entry: entry.name)
    frames = np.array([_number(entry.name) for entry in posed])
    hugs = (source / _HUGS).is_file()
    turns, scales, shifts, angles, betas = (_hugs if hugs else _aligned)(source, posed, frames)
    metre = float(np.median(scales))
    lenses, shots = {}, []
    splits = _splits(len(posed))
    sam = sorted((source / "4d_humans" / "sam_segmentations").glob("*.png")) if hugs else []
    for k, (entry, frame) in enumerate(zip(posed, frames)):
        name = f"{frame:05d}"
        camera = camera_of(entry.K, entry.R, entry.t / metre, entry.size, corner=0)
        lenses[name] = Lens(camera, entry.distortion)
        picture = source / "images" / entry.name
        mask = _mask(source, picture, sam[k] if len(sam) == len(posed) else None)
        image = partial(read_rgb, picture)
        shots.append(Shot(name, int(frame), image, mask, split=splits[k], name=picture.stem))
    rotations = axis_angle_to_matrix(angles)
    rotations[:, 0] = turns @ rotations[:, 0]

    def root(rest: Floats) -> Floats:
        """Where s (R rest) + t lies in metres: each camera's own coordinates divided by the fit's scale."""
        places = np.empty((len(posed), 3))
        for k, entry in enumerate(posed):
            world = scales[k] * turns[k] @ rest + shifts[k]  # SMPL's own root turn leaves its pelvis where it is
            local = (entry.R @ world + entry.t) / scales[k]
            places[k] = entry.R.T @ (local - entry.t / metre)
        return places

    notes = (f"COLMAP's unit is {1 / metre:.4g} m by the fits", "HUGS' fits" if hugs else "NeuMan's own fits")
    poses = Poses(frames, rotations, root, betas=mean_betas(betas))
    return Recording("NeuMan", lenses, shots, poses, FPS, notes)


def _aligned(source: Path, posed: list[Posed], frames: np.ndarray):
    """Root turns, scales, shifts of ``alignments.npy``, and the poses of the fit: x = [v, 1] · alignment (4×3)."""
    alignments = read_pickle(source / "alignments.npy", what="alignments")
    file = next((source / name for name in _FITS if (source / name).is_file()), source / _FITS[0])
    people = read_pickle(file, what="SMPL fits")
    if not isinstance(people, dict) or not people:
        raise InputError("SMPL fits", expected="a dict by person", got=type(people).__name__, file=file)
    person = next(iter(people.values()))
    pose, betas = np.asarray(person["pose"], np.float64), np.asarray(person["betas"], np.float64)
    if frames.max() >= len(pose):
        raise InputError("SMPL fits", expected=f"more than {frames.max()} frames", got=len(pose), file=file)
    turns, scales, shifts = [], [], []
    for entry, frame in zip(posed, frames):
        if entry.name not in alignments:
            raise InputError(
                "alignment", expected=entry.name, got="none", file=source / "alignments.npy", frame=int(frame)
            )
        matrix = np.asarray(alignments[entry.name], np.float64)[:4, :3]
        linear = matrix[:3].T
        scale = float(np.cbrt(np.linalg.det(linear)))
        turns.append(nearest_rotation(linear / scale))
        scales.append(scale)
        shifts.append(matrix[3])
    return (np.stack(turns), np.array(scales), np.stack(shifts), pose[frames].reshape(len(frames), -1, 3), betas)


def _hugs(source: Path, posed: list[Posed], frames: np.ndarray):
    """HUGS: x = scale · smpl(pose) + transl, one row a picture."""
    with Npz(source / _HUGS, what="SMPL fits") as archive:
        count = len(posed)
        root, body = archive.numbers("global_orient").reshape(-1, 3), archive.numbers("body_pose")
        if len(root) != count:
            raise InputError("SMPL fits", expected=f"{count} rows, one a picture", got=len(root), file=source / _HUGS)
        angles = np.concatenate([root, body.reshape(count, -1)], 1).reshape(count, -1, 3)
        scales = np.broadcast_to(archive.numbers("scale").reshape(-1), (count,))
        eye = np.broadcast_to(np.eye(3), (count, 3, 3))
        return eye, scales, archive.numbers("transl", (count, 3)), angles, archive.numbers("betas")


def _number(name: str) -> int:
    try:
        return int(Path(name).stem)
    except ValueError:
        raise InputError("picture name", expected="a frame number", got=name) from None


def _splits(count: int) -> list[Split]:
    """NeuMan's rule: every so many frames from half an interval on are held out."""
    held = range(count)[max(1, count // max(1, count // 5)) // 2 :: max(1, count // max(1, count // 5))]
    return ["novel_pose" if k in held else "train" for k in range(count)]


def _mask(source: Path, picture: Path, sam: Path | None):
    if sam is not None:
        return partial(read_mask, sam)
    file = beside(picture, source / "segmentations")
    return None if file is None else partial(_inverted, file)


def _inverted(path: Path) -> Bytes:
    """NeuMan's masks are 255 where the background is."""
    return (255 - np.where(read_mask(path) == 255, 255, 0)).astype(np.uint8)
