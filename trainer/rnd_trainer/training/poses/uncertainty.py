"""How sure the poses of a capture are: a file beside ``capture.json``, read by training where it exists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz, save_npz

Floats = NDArray[np.float64]

FILE = "uncertainty.npz"


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Deviations of the poses of F motion frames.

    Attributes:
        rotations: [F, J, 3] rad, of each joint's local rotation about its own axes.
        translations: [F, 3] m, of the root.
    """

    rotations: Floats
    translations: Floats


def save_uncertainty(folder: Path, uncertainty: PoseUncertainty) -> None:
    """Write the deviations of a capture's motion into its ``folder``."""
    arrays = {"rotation_deviation": uncertainty.rotations, "translation_deviation": uncertainty.translations}
    save_npz(folder / FILE, {name: array.astype(np.float32) for name, array in arrays.items()})


def load_uncertainty(folder: Path, frames: int, joints: int) -> PoseUncertainty | None:
    """Deviations of a capture's motion of so many frames and joints; None where the capture has none.

    Raises:
        InputError: deviations of another motion, or negative ones.
    """
    if not (folder / FILE).is_file():
        return None
    with Npz(folder / FILE, what="pose uncertainty") as archive:
        found = PoseUncertainty(
            archive.numbers("rotation_deviation", (frames, joints, 3)).astype(np.float64),
            archive.numbers("translation_deviation", (frames, 3)).astype(np.float64),
        )
    if min(found.rotations.min(), found.translations.min()) < 0:
        raise InputError("pose uncertainty", expected="deviations", got="negative ones", file=folder / FILE)
    return found
