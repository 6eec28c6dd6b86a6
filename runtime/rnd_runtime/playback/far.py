"""Figures of few pixels: rendered finer and averaged, so that they keep their width and their light.

The pixel filter (``raster.oracle.DILATION``) widens an opaque body by a fixed share of a pixel: 1.4 % of the coverage
of a person 192 pixels high, 64 % of one of 16 pixels. Blending saturates, so no factor on opacities undoes that;
smaller pixels do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.raster.oracle import NEAR

MIN_PIXELS_PER_METRE = 110.0
"""at which the filter is still small: 192 pixels for a person of 1.75 m"""
MAX_FACTOR = 64
"""fine pixels along a pixel's side; a person of 3 pixels needs them"""
MARGIN = 0.35
"""m around the joints that hair, hands and clothes stay within"""


@dataclass(frozen=True)
class FineView:
    """A part of the image of ``full``, from column ``left`` and row ``top``: ``factor``² pixels for each of its own."""

    camera: Camera
    factor: int
    left: int
    top: int
    full: Camera

    def averaged(self, raster: Raster) -> Raster:
        """``raster`` of ``camera``, box-filtered and put into the full image."""
        image, alpha, depth = (self._averaged(layer) for layer in (raster.image, raster.alpha, raster.depth))
        return replace(raster, image=image, alpha=alpha, depth=depth, srgb=None)

    def _averaged(self, layer: Floats32) -> Floats32:
        height, width, s = self.camera.height // self.factor, self.camera.width // self.factor, self.factor
        full = np.zeros((self.full.height, self.full.width, *layer.shape[2:]), np.float32)
        blocks = layer.reshape(height, s, width, s, *layer.shape[2:])
        full[self.top : self.top + height, self.left : self.left + width] = blocks.mean(axis=(1, 3), dtype=np.float32)
        return full


def fine_view(camera: Camera, points: NDArray[np.floating[Any]]) -> FineView | None:
    """The view to render instead of ``camera``; None where a body around ``points`` [N, 3] m is large enough or unseen.

    ``points`` are in the frame of ``camera``'s ``world_to_camera``.
    """
    depths = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    nearest = float(depths.min(initial=np.inf)) - MARGIN
    if not NEAR <= nearest < np.inf:  # NaN too
        return None
    factor = min(math.ceil(MIN_PIXELS_PER_METRE * nearest / min(camera.K[0, 0], camera.K[1, 1])), MAX_FACTOR)
    if factor <= 1:
        return None
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
    corners = corners @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    if not corners[:, 2].min() >= NEAR:
        return None
    pixels = corners[:, :2] / corners[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    size = np.array([camera.width, camera.height])
    (left, top), (right, bottom) = (
        np.clip(edge, 0, size) for edge in (np.floor(pixels.min(0)), np.ceil(pixels.max(0)))
    )
    if left >= right or top >= bottom:
        return None
    grid: Floats = np.diag([factor, factor, 1.0]) @ np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]])
    width, height = int(right - left) * factor, int(bottom - top) * factor
    return FineView(Camera(width, height, grid @ camera.K, camera.world_to_camera), factor, int(left), int(top), camera)
