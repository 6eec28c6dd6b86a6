"""COLMAP's text models: cameras.txt and images.txt."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.rotations import quaternion_to_matrix
from rnd_trainer.importing.images import pinhole

Floats = NDArray[np.float64]

_MODELS = {"SIMPLE_PINHOLE": (1, 0), "PINHOLE": (2, 0), "SIMPLE_RADIAL": (1, 1), "RADIAL": (1, 2), "OPENCV": (2, 4)}
"""camera model → number of focal lengths, number of distortion coefficients in OpenCV's order"""


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """An image with its camera: K with pixel centres at +0.5, world-to-camera R and t in COLMAP's unit."""

    name: str
    size: tuple[int, int]
    K: Floats
    distortion: tuple[float, ...]
    R: Floats
    t: Floats


def read_text_model(folder: Path) -> list[ColmapImage]:
    """Every registered image of a text model, in its order.

    Raises:
        InputError: a line that does not follow the format, or a lens model with fisheye terms.
    """
    cameras = {}
    cameras_file, images_file = folder / "cameras.txt", folder / "images.txt"
    for number, fields in _lines(cameras_file):
        try:
            focals, terms = _MODELS[fields[1]]
            size = int(fields[2]), int(fields[3])
            values = [float(field) for field in fields[4:]]
            K = pinhole(values[0], values[focals - 1], *values[focals : focals + 2])
            distortion = (*values[focals + 2 : focals + 6], 0.0, 0.0, 0.0, 0.0)[:4] if terms else ()
        except KeyError:
            raise InputError("lens model", expected=", ".join(_MODELS), got=fields[1], file=cameras_file) from None
        except (ValueError, IndexError, TypeError) as error:
            raise _bad_line(cameras_file, number) from error
        cameras[fields[0]] = (size, K, distortion)
    images = []
    for number, fields in _lines(images_file)[::2]:  # every second line lists points
        try:
            q, t = np.array(fields[1:5], np.float64), np.array(fields[5:8], np.float64)
            images.append(ColmapImage(" ".join(fields[9:]), *cameras[fields[8]], quaternion_to_matrix(q), t))
        except (KeyError, ValueError, IndexError) as error:
            raise _bad_line(images_file, number) from error
    if not images:
        raise InputError("images", expected="some", got="none", file=images_file)
    return images


def _bad_line(file: Path, line: int) -> InputError:
    return InputError(f"line {line}", expected="COLMAP's text format", file=file)


def _lines(file: Path) -> list[tuple[int, list[str]]]:
    """(number, fields) of lines except comments; in images.txt an empty line is an image without points."""
    text = existing_file(file, what="COLMAP model").read_text(encoding="utf-8", errors="replace")
    lines = [(k + 1, line.split()) for k, line in enumerate(text.splitlines()) if not line.startswith("#")]
    return lines if file.name == "images.txt" else [(k, fields) for k, fields in lines if fields]
