"""Gaussians visible to a camera: in its frame, facing it, unoccluded."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.raster.cpu import rasterize
from rnd_trainer.model.model import PosedGaussians


@torch.no_grad()
def in_sight(
    posed: PosedGaussians, camera: Camera, count: int, *, facing: float, occlusion: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Visibility [count] of the first ``count`` Gaussians, and their pixels [count, 2].

    Args:
        facing: smallest cosine between normal and direction to the camera.
        occlusion: distance behind the first surface up to which a Gaussian is visible, m.

    Pixels are x, y with centres at +0.5; 0 outside the frame.
    """
    arrays = (posed.means, posed.covariances, posed.attributes.opacity, posed.normals)
    means, covariances, opacities, normals = (x.detach().cpu().numpy() for x in arrays)
    features = np.zeros((len(means), 1), np.float32)
    raster = rasterize(means, covariances, opacities, features, camera, depth=True)
    means, normals = means[:count], normals[:count]
    local = means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    inside = (local[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    pixels = np.where(inside[:, None], pixels, 0)
    column, row = pixels.astype(int).T
    depth = raster.depth[row, column] / np.maximum(raster.alpha[row, column], 1e-6)
    towards = camera.position - means
    faces = (normals * towards).sum(1) > facing * np.linalg.norm(towards, axis=1)
    return inside & faces & (local[:, 2] < depth + occlusion), pixels
