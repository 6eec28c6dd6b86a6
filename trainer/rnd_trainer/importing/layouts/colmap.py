"""COLMAP's text models: cameras.txt and images.txt."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.rotations import quaternion_to_matrix

Floats = NDArray[np.float64]

# Parameters of each camera model: focal lengths, centre, distortion in OpenCV's order
_MODELS = {
    "SIMPLE_PINHOLE": ("ffxy", 0),
    "PINHOLE": ("fgxy", 0),
    "SIMPLE_RADIAL": ("ffxy", 1),
    "RADIAL": ("ffxy", 2),
    "OPENCV": ("fgxy", 4),
}


@dataclass(frozen=True, eq=False)
class Posed:
    """A picture with its camera: K with pixel centres at +0.5, world-to-camera R and t in COLMAP's unit."""

    name: str
    size: tuple[int, int]
    K: Floats
    distortion: tuple[float, ...]
    R: Floats
    t: Floats


def read_text_model(folder: Path) -> list[Posed]:
    """Every registered picture of a text model, in its order.

    Raises:
        InputError: a line that does not follow the format, or a lens model with fisheye terms.
    """
    cameras = {}
    for number, fields in _lines(folder / "cameras.txt"):
        try:
            name, model, width, height = fields[0], fields[1], int(fields[2]), int(fields[3])
            values = [float(field) for field in fields[4:]]
            layout, bent = _MODELS[model]
            single = layout.startswith("ff")
            f, g = values[0], values[0 if single else 1]
            x, y = values[1:3] if single else values[2:4]
            radial = [*values[3 if single else 4 :], 0.0, 0.0, 0.0, 0.0][:4] if bent else []
        except KeyError:
            raise InputError(
                "lens model", expected=", ".join(_MODELS), got=fields[1], file=folder / "cameras.txt"
            ) from None
        except (ValueError, IndexError) as error:
            raise _bad(folder / "cameras.txt", number) from error
        cameras[name] = ((width, height), np.array([[f, 0, x], [0, g, y], [0, 0, 1.0]]), tuple(radial))
    posed = []
    for number, fields in _lines(folder / "images.txt")[::2]:  # every second line lists points
        try:
            q, t = np.array(fields[1:5], np.float64), np.array(fields[5:8], np.float64)
            size, K, distortion = cameras[fields[8]]
            posed.append(Posed(" ".join(fields[9:]), size, K, distortion, quaternion_to_matrix(q), t))
        except (KeyError, ValueError, IndexError) as error:
            raise _bad(folder / "images.txt", number) from error
    if not posed:
        raise InputError("pictures", expected="some", got="none", file=folder / "images.txt")
    return posed


def _bad(file: Path, line: int) -> InputError:
    return InputError(f"line {line}", expected="COLMAP's text format", file=file)


def _lines(file: Path) -> list[tuple[int, list[str]]]:
    """(number, fields) of the lines that are no comments; empty lines count (a picture without points)."""
    text = existing_file(file, what="COLMAP model").read_text(encoding="utf-8", errors="replace")
    lines = [(k + 1, line.split()) for k, line in enumerate(text.splitlines()) if not line.startswith("#")]
    return lines if file.name == "images.txt" else [(k, fields) for k, fields in lines if fields]
