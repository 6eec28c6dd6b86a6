"""Light probes made by formula."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rnd_runtime.shading.light import Light, texel_directions

SUN_RADIUS = 0.02  # rad; four times the sun's, so that it covers texels of a map of 128 rows


def sun_and_sky(height: int = 128, *, sun: ArrayLike = (0.8, 0.5, 0.33), radiance: float = 900.0) -> Light:
    """A bluish sky, a dark ground and a sun towards ``sun`` with a normal irradiance of about π."""
    directions = texel_directions(height, 2 * height)
    up = 0.5 + 0.5 * directions[..., 1:2]
    colours = 0.05 + up * np.array([0.25, 0.3, 0.4])
    return Light((colours + sun_disc(height, sun, radiance) * np.array([1.0, 0.95, 0.85])).astype(np.float32))


def sun_disc(height: int, towards: ArrayLike, radiance: float, radius: float = SUN_RADIUS) -> np.ndarray:
    """A disc of ``radiance`` as a map [H, 2H, 1], each texel weighted by its covered share (8 × 8 samples)."""
    fine = 8
    way = np.asarray(towards, np.float64) / np.linalg.norm(towards)
    rows = np.arange(height)
    polar = (rows + 0.5) / height * np.pi
    near = np.abs(polar - np.arccos(way[1])) < radius + 2 * np.pi / height
    result = np.zeros((height, 2 * height, 1))
    azimuth = (np.arange(2 * height * fine) + 0.5) / (2 * height * fine) * 2 * np.pi - np.pi
    for row in rows[near]:
        theta = (row + (np.arange(fine) + 0.5) / fine)[:, None] / height * np.pi
        cosine = np.sin(theta) * (np.cos(azimuth) * way[0] + np.sin(azimuth) * way[2]) + np.cos(theta) * way[1]
        inside = np.where(cosine > np.cos(radius), np.sin(theta), 0).reshape(fine, 2 * height, fine)
        result[row, :, 0] = inside.sum((0, 2)) / (np.sin(theta).sum() * fine)
    return radiance * result
