"""The hue of a learned light against that of the true one, on surfaces of twelve directions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.shading.light import REC709_LUMINANCE, Light, texel_directions, texel_solid_angles

Floats = NDArray[np.float64]

LUMINANCE = 0.5  # at which both are compared: the level is a figure of its own
GOLDEN = (1 + 5**0.5) / 2
ICOSAHEDRON = np.array([np.roll([0, a, b * GOLDEN], shift) for shift in range(3) for a in (1, -1) for b in (1, -1)])


def hue_difference(learned: Floats, true: Light) -> float:
    """Mean CIE 1976 ΔE between irradiances of equal luminance under ``learned`` [h, 2h, 3] and ``true``."""
    shape = learned.shape[:2]
    directions = texel_directions(*shape)
    maps = (learned, true.resized(*shape).sample(directions))
    normals = ICOSAHEDRON / np.linalg.norm(ICOSAHEDRON[0])
    share = np.maximum(normals @ directions.reshape(-1, 3).T, 0) * texel_solid_angles(*shape).reshape(-1)
    first, second = (_lab(share @ np.asarray(radiance, np.float64).reshape(-1, 3)) for radiance in maps)
    return float(np.linalg.norm(first - second, axis=-1).mean())


def _lab(linear: Floats) -> Floats:
    """CIELAB [N, 3] under D65 of ``linear`` [N, 3] Rec.709, scaled to ``LUMINANCE``."""
    scaled = linear * (LUMINANCE / np.maximum(linear @ REC709_LUMINANCE, 1e-12))[:, None]
    return np.asarray(cv2.cvtColor(linear_to_srgb(scaled).astype(np.float32)[None], cv2.COLOR_RGB2Lab)[0], np.float64)
