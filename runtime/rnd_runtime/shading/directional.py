"""Extraction of directional lights from a light probe, so that they can cast hard shadows.

Compact peaks are removed and replaced by the background around them: sky + directional lights = map, per channel, up to
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .light import REC709_LUMINANCE, Light, texel_directions, texel_solid_angles

Floats = NDArray[np.float64]

_CAP = np.radians(6)  # max radius of a peak: a sun with its glare, a softbox at 2 m
_RING = np.radians(10)  # outer radius of the ring from _CAP on whose median is the background
_LARGEST = (512, 1024)  # max map size: 1/3° per texel
_MIN_SHARE = 0.05  # of the map's luminance
_MAX_PEAKS = 16  # candidates: lamps below _MIN_SHARE may be brighter than the sun
_LAMP = np.radians(2)  # spread above which a peak below _MIN_SHARE is a window and ends the search
_RING_AREA = 2 * np.pi * (1 - np.cos(_RING))  # sr, upper bound of a peak's area


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A compact bright light, infinitely far away.

    Attributes:
        direction: [3] unit, towards it, in the light probe's frame: the mean direction of its radiance.
        irradiance: [3] ∫ L dω, linear, on a surface that faces it.
        spread: rad, root mean square angle of its texels' centres from ``direction``: 0 for a single texel.
    """

    direction: Floats
    irradiance: Floats
    spread: float


def extract_directional(light: Light, *, limit: int = 2) -> tuple[Light, tuple[DirectionalLight, ...]]:
    """Split ``light`` into the rest and at most ``limit`` directional lights, strongest first.

    A directional light is the excess over the median of the ring around a brightest texel, within 6° of its own centre,
    with at least 5 % of the map's luminance. A weaker small lamp is skipped for the next brightest texel more than 6°
    away. An overcast sky or a wide window has none. Maps of more than 512 rows are downsized to 512.
    """
    if len(light.radiance) > _LARGEST[0]:
        light = light.resized(*_LARGEST)
    radiance = light.radiance.astype(np.float64)
    height, width = radiance.shape[:2]
    solid_angles = texel_solid_angles(height, width)[:, 0]
    luminance = radiance @ REC709_LUMINANCE
    min_luminance = _MIN_SHARE * float(luminance.sum(1) @ solid_angles)
    directions = texel_directions(height, width)
    lights: list[DirectionalLight] = []
    for _ in range(_MAX_PEAKS):
        peak = np.unravel_index(np.argmax(luminance), luminance.shape)
        if not luminance[peak] * _RING_AREA >= min_luminance:
            break
        found = _peak_around(radiance, directions, solid_angles, directions[peak])
        if found is None:
            break
        peak_light, rows, sky = found
        if not peak_light.irradiance @ REC709_LUMINANCE >= max(min_luminance, 1e-30):
            if peak_light.spread > _LAMP:
                break
            luminance[directions @ directions[peak] > np.cos(_CAP)] = -np.inf
            continue
        radiance[rows] = sky
        luminance[rows] = np.minimum(luminance[rows], sky @ REC709_LUMINANCE)
        lights.append(peak_light)
        if len(lights) == limit:
            break
    lights.sort(key=lambda peak_light: -float(peak_light.irradiance @ REC709_LUMINANCE))
    return replace(light, radiance=radiance.astype(np.float32)), tuple(lights)


def _peak_around(
    radiance: Floats, directions: Floats, solid_angles: Floats, centre: Floats
) -> tuple[DirectionalLight, slice, Floats] | None:
    """The excess of ``radiance`` over its surroundings near ``centre``, its rows, and these rows without it."""
    for _ in range(3):  # recentre from the brightest texel to the mean
        rows = _rows_within(len(radiance), centre, _RING)
        cosine = directions[rows] @ centre
        inside, ring = cosine > np.cos(_CAP), (cosine <= np.cos(_CAP)) & (cosine > np.cos(_RING))
        if not inside.any() or not ring.any():  # too coarse a map
            return None
        background = np.median(radiance[rows][ring], axis=0)
        # in float32, as the sky is stored: the light gets its rounding errors
        sky = np.where(inside[..., None], np.minimum(radiance[rows], background), radiance[rows])
        sky = sky.astype(np.float32).astype(np.float64)
        flux = np.where(inside[..., None], (radiance[rows] - sky) * solid_angles[rows, None, None], 0)
        weight = flux @ REC709_LUMINANCE
        mean = np.einsum("hw,hwc->c", weight, directions[rows])
        if not np.linalg.norm(mean) > 0:
            return None
        centre = mean / np.linalg.norm(mean)
    # 1 − cos θ ≈ θ²/2, and the mean of unit vectors is shorter than 1 by its mean
    spread = np.sqrt(max(2 * (1 - np.linalg.norm(mean) / weight.sum()), 0))
    return DirectionalLight(centre, flux.sum((0, 1)), float(spread)), rows, sky


def _rows_within(height: int, centre: Floats, angle: float) -> slice:
    """Rows of a lat-long map within ``angle`` of ``centre``."""
    polar = np.arccos(np.clip(centre[1], -1, 1))
    first, last = (polar - angle) / np.pi * height, (polar + angle) / np.pi * height
    return slice(max(int(np.floor(first)), 0), min(int(np.ceil(last)) + 1, height))
