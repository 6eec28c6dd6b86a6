"""Gaussians visible to a camera: in its frame, facing it, unoccluded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.raster.cpu import rasterize
from rnd_trainer.model.model import PosedGaussians


class Sight(NamedTuple):
    """What a camera sees of Gaussians: whether it sees them, their pixels, and the surface there.

    Attributes:
        visible: [count].
        pixels: [count, 2] x, y with centres at +0.5; 0 outside the frame.
        normals: [count, 3] unit, of the splatted surface at the pixel. Near an outline a Gaussian lies behind surface
            that faces the camera more than it does, by 15° where n·v is 0.4.
    """

    visible: NDArray[np.bool_]
    pixels: NDArray[np.float64]
    normals: NDArray[np.float32]


@torch.no_grad()
def in_sight(posed: PosedGaussians, camera: Camera, count: int, *, facing: float, occlusion: float) -> Sight:
    """What ``camera`` sees of the first ``count`` Gaussians.

    Args:
        facing: smallest cosine between normal and direction to the camera.
        occlusion: distance behind the first surface up to which a Gaussian is visible, m.
    """
    arrays = (posed.means, posed.covariances, posed.attributes.opacity, posed.normals)
    means, covariances, opacities, normals = (np.ascontiguousarray(x.detach().cpu().numpy()) for x in arrays)
    raster = rasterize(means, covariances, opacities, normals, camera, depth=True)
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
    surface = raster.image[row, column]
    surface = surface / np.maximum(np.linalg.norm(surface, axis=1, keepdims=True), 1e-6)
    return Sight(inside & faces & (local[:, 2] < depth + occlusion), pixels, surface)
