"""The pose prior of the video fit, from motion capture beside the clone; the motions themselves stay out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_trainer.estimating.fitting.prior import make_prior, save_prior

MOTIONS = Path(__file__).parents[3] / "shared" / "data" / "mocap"


def make_pose_prior(path: Path) -> None:
    """Write mean and whitening matrix of the local rotation vectors of all motions."""
    files = sorted(MOTIONS.glob("*.npz"))
    if not files:
        raise InputError("motions", expected="some .npz", got="none", file=MOTIONS)
    poses = []
    for file in files:
        with Npz(file, what="motions") as archive:
            poses.append(archive.numbers("poses", (None, 22, 3)).astype(np.float64))
    save_prior(path, make_prior(np.concatenate(poses)))
