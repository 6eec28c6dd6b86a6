"""Readers of images, masks and calibration of other programs, and numbered files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_header, read_image
from rnd_runtime.core.npz import array_bytes, array_header

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
_MAX_LABELS = 32
"""a mask with at most so many values, none above 127, holds labels, not coverage"""
_DIGITS = 20
"""more digits than a number in a file's name"""


def read_rgb(path: Path) -> Bytes:
    """Image [H, W, 3] as 8-bit sRGB; grey is repeated, alpha dropped, 16 bit rounded."""
    pixels = read_image(path)
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise InputError("image", expected="8 or 16 bit", got=str(pixels.dtype), file=path)
    return np.ascontiguousarray(np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3])


def read_mask(path: Path) -> Bytes:
    """A mask [H, W] as coverage 0…255.

    Reads alpha, 0/255 and soft greys, 0/1, body-part labels, and coloured palettes. ``.npy`` holds [H, W] of the same,
    or SAM 2's [1, H, W].
    """
    if path.suffix == ".npy":
        pixels = load_array(path, "mask")
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
    pixels = pixels.astype(np.int64)
    if pixels.shape[2] in (2, 4) and np.ptp(pixels[..., -1]) > 0:
        mask = pixels[..., -1]
    elif pixels.shape[2] >= 3 and (pixels[..., :1] != pixels[..., 1:3]).any():
        mask = 255 * (pixels[..., :3].max(-1) > 0)  # a palette's colours
    else:
        mask = pixels[..., 0]
    if mask.size and mask.max() <= 127 and len(np.unique(mask)) <= _MAX_LABELS:
        mask = 255 * (mask > 0)
    return np.clip(mask, 0, 255).astype(np.uint8)


def mask_reader(path: Path | None) -> Callable[[], Bytes] | None:
    """``read_mask`` of ``path`` on demand; None without a file."""
    return None if path is None else partial(read_mask, path)


def load_array(path: Path, what: str) -> NDArray[Any]:
    """The array of an ``.npy`` file."""
    path = existing_file(path, what=what)
    try:
        with path.open("rb") as stream:
            Budget.of(path).take(array_bytes(*array_header(stream)), what)
        return np.asarray(np.load(path, allow_pickle=False))
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{what} cannot be read", expected="an array of numbers", file=path) from error


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, from its header."""
    header = read_header(path)
    return header.width, header.height


def list_files(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The files of ``folder`` with one of ``suffixes``, in ``natural_key`` order; at least one."""
    files = [p for p in folder.glob("*") if p.suffix.lower() in suffixes] if folder.is_dir() else []
    found = sorted(files, key=lambda file: natural_key(file.name))
    if not found:
        raise InputError("images", expected=f"{' or '.join(suffixes)} files", got="none", file=folder)
    return found


def natural_key(name: str) -> tuple[str, str]:
    """Sort key of names by their numbers: frame2 before frame10."""
    return re.sub("[0-9]+", lambda digits: digits[0].zfill(_DIGITS), name), name


def frame_number(file: Path) -> int:
    """The frame number that is the stem of ``file``."""
    if not file.stem.isdecimal():
        raise InputError("file name", expected="a frame number", got=file.name, file=file)
    return int(file.stem)


def last_number(name: str) -> int | None:
    """The number at the end of ``name``."""
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits else None


def numbers_of(files: Sequence[Path]) -> list[int] | None:
    """The number at the end of each file's name; None unless each has one of its own."""
    numbers = [number for file in files if (number := last_number(file.stem)) is not None]
    return numbers if len(set(numbers)) == len(files) else None


def count_shift(frames: Sequence[int], numbers: Sequence[int]) -> int:
    """Offset from the ``numbers`` of files to those of ``frames``, both ascending.

    They are equal if one set contains the other. Otherwise the offset is that of the first numbers, if both are equally
    many and consecutive, or if ``frames`` are consecutive from 1 and ``numbers`` an incomplete range from 0.
    """
    if set(frames) <= set(numbers) or set(numbers) <= set(frames):
        return 0
    extent = numbers[-1] - numbers[0] + 1
    equally_many = extent == len(frames) and min(frames[0], numbers[0]) <= 1
    from_zero = extent <= len(frames) and (numbers[0], frames[0]) == (0, 1)
    in_a_row = frames[-1] - frames[0] + 1 == len(frames)
    return frames[0] - numbers[0] if in_a_row and (equally_many or from_zero) else 0


def find_beside(path: Path, *folders: Path) -> Path | None:
    """The first mask file in ``folders`` with the stem of ``path``."""
    for folder in folders:
        for suffix in (".png", ".npy", ".jpg", ".jpg.png"):
            candidate = folder / (path.stem + suffix)
            if candidate.is_file():
                return candidate
    return None


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    try:
        return json.loads(existing_file(path, what="file").read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError("cannot be read", expected="JSON", got=str(error), file=path) from error


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Floats:
    """The intrinsics [3, 3] of focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def distortion_of(values: ArrayLike) -> tuple[float, ...]:
    """Distortion coefficients of an array of any shape."""
    return tuple(np.asarray(values, np.float64).reshape(-1).tolist())


def camera_of(K: ArrayLike, R: ArrayLike, T: ArrayLike, size: tuple[int, int], *, corner: float = 0.5) -> Camera:
    """A camera of world-to-camera R, T (m).

    ``corner`` is added to the principal point: 0.5 for sources with pixel centres at whole numbers, as in OpenCV's
    calibration; 0 for those with pixel centres at +0.5, as in COLMAP's.
    """
    intrinsics = np.array(K, np.float64).reshape(3, 3).copy()
    intrinsics[:2, 2] += corner
    pose = np.eye(4)
    pose[:3, :3] = nearest_rotation(np.array(R, np.float64).reshape(3, 3))
    pose[:3, 3] = np.array(T, np.float64).reshape(3)
    return Camera(*size, intrinsics, pose)


def nearest_rotation(matrix: Floats) -> Floats:
    """Rotation nearest to ``matrix`` [3, 3]; ``matrix`` itself if none is near."""
    u, _, v = np.linalg.svd(matrix)
    rotation: Floats = u @ v
    return rotation if np.abs(rotation - matrix).max() < 1e-2 else matrix


def rotation_between(a: Floats, b: Floats) -> Floats:
    """The smallest rotation [3, 3] from the unit vector ``a`` to ``b``, less than 180° apart."""
    v = np.cross(a, b)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation: Floats = np.eye(3) + cross + cross @ cross / (1 + a @ b)
    return rotation


def check_size(pixels: NDArray[Any], camera: Camera, what: str) -> NDArray[Any]:
    """``pixels``; ``InputError`` unless they have the camera's size."""
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height} as the camera"
        raise InputError(f"size of {what}", expected=expected, got=f"{width} x {height}")
    return pixels


def read_sized(read: Callable[[Path], NDArray[Any]], file: Path, camera: Camera, what: str) -> NDArray[Any]:
    """``read(file)``, checked to have the camera's size."""
    try:
        return check_size(read(file), camera, what)
    except InputError as error:
        raise error.at(file=file) from error


def undistort_image(pixels: NDArray[Any], camera: Camera, distortion: tuple[float, ...]) -> NDArray[Any]:
    """``pixels`` [H, W, …] without ``distortion``, K unchanged; zero outside."""
    if not any(distortion):
        return pixels
    K = camera.K.copy()
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are at whole numbers
    maps = cv2.initUndistortRectifyMap(K, np.array(distortion), None, K, (camera.width, camera.height), cv2.CV_32FC1)
    return cv2.remap(pixels, *maps, cv2.INTER_LINEAR)
