"""The embedded template with few vertices: unwrapping the whole one takes 20 s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.capture.body import Body
from support.tiny import body

CELL = 0.03  # m


def write_coarse_body(path: Path) -> Path:
    """Write the template with the vertices of each cell of a grid merged, as ``body.npz``; its path."""
    whole = body()
    _, cell = np.unique(np.floor(whole.vertices / CELL).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)[:, None]
    vertices, weights = (
        np.stack([np.bincount(cell, column) for column in values.T], axis=1) / count
        for values in (whole.vertices, whole.skinning_weights)
    )
    faces = cell[whole.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    Body(vertices, faces.astype(np.int32), weights.astype(np.float32), whole.skeleton).save(path)
    return path
