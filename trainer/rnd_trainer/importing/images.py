"""Pictures, masks and calibration as other programs store them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_header, read_image

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

PICTURES = (".jpg", ".jpeg", ".png")
_LABELS = 32
"""a mask of fewer different values, none above 127, holds labels (0/1, body parts), not coverage"""
_DIGITS = 20
"""more than a number in a file's name has"""


def read_rgb(path: Path) -> Bytes:
    """A picture [H, W, 3] as 8-bit sRGB; grey is repeated, alpha dropped, 16 bit rounded."""
    pixels = read_image(path)
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise InputError("picture", expected="8 or 16 bit", got=str(pixels.dtype), file=path)
    return np.ascontiguousarray(np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3])


def read_mask(path: Path) -> Bytes:
    """A mask [H, W] as coverage 0…255, from what people store.

    Alpha where there is one; 0/255 and soft greys as they are; 0/1, body-part labels and coloured palettes: all
    that is not zero is the person. ``.npy`` holds [H, W] of the same, or [1, H, W], as SAM 2 gives it.
    """
    if path.suffix == ".npy":
        try:
            pixels = np.load(existing_file(path, what="mask"), allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise InputError("mask cannot be read", expected="an array of numbers", file=path) from error
        pixels = pixels[0] if pixels.ndim == 3 and len(pixels) == 1 else pixels
        if pixels.ndim not in (2, 3):
            raise InputError("mask", expected="[H, W]", got=list(pixels.shape), file=path)
        pixels = pixels.reshape(*pixels.shape[:2], -1)
    else:
        pixels = read_image(path)
    if pixels.dtype.kind not in "bui" and pixels.size and pixels.max() <= 1:
        pixels = np.round(255 * np.clip(pixels, 0, 1))  # floats are coverage
    elif pixels.dtype == np.uint16:
        pixels = np.ceil(pixels / 257)  # up: a label of 1 stays one
    return as_coverage(pixels)


def as_coverage(pixels: NDArray[Any]) -> Bytes:
    """[H, W, C] of any of ``read_mask``'s kinds as coverage [H, W]."""
    pixels = pixels.astype(np.int64)
    if pixels.shape[2] in (2, 4) and np.ptp(pixels[..., -1]) > 0:
        mask = pixels[..., -1]
    elif pixels.shape[2] >= 3 and (pixels[..., :1] != pixels[..., 1:3]).any():
        mask = 255 * (pixels[..., :3].max(-1) > 0)  # a palette's colours
    else:
        mask = pixels[..., 0]
    if mask.size and mask.max() <= 127 and len(np.unique(mask)) <= _LABELS:
        mask = 255 * (mask > 0)
    return np.clip(mask, 0, 255).astype(np.uint8)


def sized(path: Path) -> tuple[int, int]:
    """Width and height of a picture, from its header."""
    header = read_header(path)
    return header.width, header.height


def listed(folder: Path, suffixes: tuple[str, ...] = PICTURES) -> list[Path]:
    """The files of ``folder`` with one of ``suffixes``, in ``natural`` order; at least one."""
    files = [p for p in folder.glob("*") if p.suffix.lower() in suffixes] if folder.is_dir() else []
    found = sorted(files, key=lambda file: natural(file.name))
    if not found:
        raise InputError("pictures", expected=f"{' or '.join(suffixes)} files", got="none", file=folder)
    return found


def natural(name: str) -> tuple[str, str]:
    """A key that sorts by the numbers in names: frame2 before frame10. Zero-padded ones keep their order."""
    return re.sub("[0-9]+", lambda digits: digits[0].zfill(_DIGITS), name), name


def last_number(name: str) -> int | None:
    """The number that ``name`` ends in."""
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits else None


def numbers_of(files: Sequence[Path]) -> list[int] | None:
    """The number that each file's name ends in; None unless each has one of its own."""
    numbers = [number for file in files if (number := last_number(file.stem)) is not None]
    return numbers if len(set(numbers)) == len(files) else None


def count_shift(frames: Sequence[int], theirs: Sequence[int]) -> int:
    """What to add to ``theirs``, numbers of files, to get those of ``frames``; both ascend. 0: they mean the same.

    They do where all of one's are among the other's. Else one may have been counted from 0 and the other from 1
    (ffmpeg's pictures do) or from somewhere in a longer video: then they are as many in a row, or theirs, some of them
    missing, begin with a 0 that the frames, from 1, have not.
    """
    if set(frames) <= set(theirs) or set(theirs) <= set(frames):
        return 0
    extent = theirs[-1] - theirs[0] + 1
    as_many = extent == len(frames) and min(frames[0], theirs[0]) <= 1
    from_zero = extent <= len(frames) and (theirs[0], frames[0]) == (0, 1)
    in_a_row = frames[-1] - frames[0] + 1 == len(frames)
    return frames[0] - theirs[0] if in_a_row and (as_many or from_zero) else 0


def beside(path: Path, *folders: Path) -> Path | None:
    """The first file called like ``path`` (any suffix of a mask) in ``folders``."""
    for folder in folders:
        for suffix in (".png", ".npy", ".jpg", ".jpg.png"):
            candidate = folder / (path.stem + suffix)
            if candidate.is_file():
                return candidate
    return None


def read_json(path: Path) -> Any:
    """A JSON file's content."""
    try:
        return json.loads(existing_file(path, what="file").read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError("cannot be read", expected="JSON", got=str(error), file=path) from error


def camera_of(K: ArrayLike, R: ArrayLike, T: ArrayLike, size: tuple[int, int], *, corner: float = 0.5) -> Camera:
    """A camera of world-to-camera R, T (metres).

    ``corner`` is added to the principal point: 0.5 where a source, like OpenCV's calibration, puts pixel centres
    at whole numbers; 0 where, like ours and COLMAP's, they lie at +0.5.
    """
    intrinsics = np.array(K, np.float64).reshape(3, 3).copy()
    intrinsics[:2, 2] += corner
    pose = np.eye(4)
    pose[:3, :3] = nearest_rotation(np.array(R, np.float64).reshape(3, 3))
    pose[:3, 3] = np.array(T, np.float64).reshape(3)
    return Camera(*size, intrinsics, pose)


def nearest_rotation(matrix: Floats) -> Floats:
    """The rotation nearest to a 3×3 that rounding has bent; what is no rotation at all stays what it is."""
    u, _, v = np.linalg.svd(matrix)
    rotation: Floats = u @ v
    return rotation if np.abs(rotation - matrix).max() < 1e-2 else matrix


def fitting(pixels: NDArray[Any], camera: Camera, what: str) -> NDArray[Any]:
    """``pixels`` if they are of the camera's size."""
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height} as the camera"
        raise InputError(f"size of {what}", expected=expected, got=f"{width} x {height}")
    return pixels


def fitting_file(read: Callable[[Path], NDArray[Any]], file: Path, camera: Camera, what: str) -> NDArray[Any]:
    """What ``read`` makes of ``file``, if it is of the camera's size."""
    try:
        return fitting(read(file), camera, what)
    except InputError as error:
        raise error.at(file=file) from error


def undistorted(
    pixels: NDArray[Any], camera: Camera, distortion: tuple[float, ...], interpolation: int = cv2.INTER_LINEAR
) -> NDArray[Any]:
    """``pixels`` [H, W, …] as a lens without ``distortion`` would have given them, K unchanged; zero beyond."""
    if not any(distortion):
        return pixels
    K = camera.K.copy()
    K[:2, 2] -= 0.5  # OpenCV's pixel centres lie at whole numbers
    maps = cv2.initUndistortRectifyMap(K, np.array(distortion), None, K, (camera.width, camera.height), cv2.CV_32FC1)
    return cv2.remap(pixels, *maps, interpolation)
