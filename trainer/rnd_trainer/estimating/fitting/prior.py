"""How people pose: a Gaussian of the joints' local rotation vectors, measured on motion capture.

Data: mocap.cs.cmu.edu (NSF EIA-0196217) and Mesh2Motion (CC0); 62 minutes, mirrored; ``make_prior`` made the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.npz import Npz, save_npz

from .figure import JOINTS

Floats = NDArray[np.float64]

FILE = Path(__file__).with_name("prior.npz")
MIN_DEVIATION = 0.06
"""rad, added to every joint's: the data hold no forearm twist and few toes"""
_MIRROR = [JOINTS.index(n.replace("left", "*").replace("right", "left").replace("*", "right")) for n in JOINTS]


@dataclass(frozen=True, eq=False)
class Prior:
    """Rotation vectors θ [21, 3] of all joints but the root: ``whiten`` @ (θ − mean) is standard normal.

    Attributes:
        mean: [63] rad; whiten: [63, 63] upper triangular, rad⁻¹.
    """

    mean: Floats
    whiten: Floats


@cache
def pose_prior() -> Prior:
    with Npz(FILE, what="pose prior") as archive:
        return Prior(archive.numbers("mean", (63,)), archive.numbers("whiten", (63, 63)))


def make_prior(poses: Floats) -> Prior:
    """Prior of rotation vectors ``poses`` [N, 22, 3] rad and of their mirror images."""
    mirrored = poses[:, _MIRROR] * np.array([1.0, -1.0, -1.0])
    values = np.concatenate([poses, mirrored])[:, 1:].reshape(2 * len(poses), -1)
    mean = values.mean(0)
    covariance = np.cov((values - mean).T) + MIN_DEVIATION**2 * np.eye(values.shape[1])
    return Prior(mean, np.linalg.cholesky(np.linalg.inv(covariance)).T)


def save_prior(path: Path, prior: Prior) -> None:
    save_npz(path, {"mean": prior.mean.astype(np.float32), "whiten": prior.whiten.astype(np.float32)})
