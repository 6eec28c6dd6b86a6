"""Extracts directional lights from a light probe, so that they can cast hard shadows.

Compact peaks are split off and the rest of the map keeps the background that surrounded them: sky + directional lights
= map, per channel, to rounding. A light's spread is measured between texel centres, so a single texel spreads by 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .light import REC709_LUMINANCE, Light, texel_directions, texel_solid_angles

Floats = NDArray[np.float64]

_CAP = np.radians(6)  # a peak must fit into this radius: a sun with its glare, a softbox two metres away
_RING = np.radians(10)  # its background is the median between _CAP and here
_LARGEST = (512, 1024)  # a third of a degree a texel tells the direction; larger maps only cost memory
_MIN_SHARE = 0.05  # of the map's luminance; less is not worth a shadow of its own
_MAX_PEAKS = 16  # that are looked at: lamps too weak for a sun may be brighter than it
_LAMP = np.radians(2)  # of their spread: what is wider and no sun is a window, whose pieces are none either
_RING_AREA = 2 * np.pi * (1 - np.cos(_RING))  # sr: more than a peak covers, whatever the texels


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A compact bright light, infinitely far away.

    Attributes:
        direction: [3] unit, towards it, in the light probe's frame: the mean direction of its radiance.
        irradiance: [3] ∫ L dω, linear: what it lays on a surface that faces it.
        spread: root mean square angle from ``direction``, radians, of its texels' centres: 0 for a single texel.
    """

    direction: Floats
    irradiance: Floats
    spread: float


def extract_directional(light: Light, *, limit: int = 2) -> tuple[Light, tuple[DirectionalLight, ...]]:
    """``light`` without its directional lights, and these, strongest first.

    One is what rises above the median of the ring around the brightest texel, within 6° of its own centre,
    if that is at least 5 % of the map's luminance; a small lamp that is weaker is passed over for the next brightest
    texel more than 6° away. An overcast sky or a wide window has none. Maps of more than 512 rows come back at 512.
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
        if not luminance[peak] * _RING_AREA >= min_luminance:  # neither this nor what is darker
            break
        found = _peak_around(radiance, directions, solid_angles, directions[peak])
        if found is None:
            break
        peak_light, rows, sky = found
        if not peak_light.irradiance @ REC709_LUMINANCE >= max(min_luminance, 1e-30):
            if peak_light.spread > _LAMP:
                break
            luminance[directions @ directions[peak] > np.cos(_CAP)] = -np.inf  # in the search alone
            continue
        radiance[rows] = sky
        luminance[rows] = np.minimum(luminance[rows], sky @ REC709_LUMINANCE)  # what is masked stays so
        lights.append(peak_light)
        if len(lights) == limit:
            break
    lights.sort(key=lambda peak_light: -float(peak_light.irradiance @ REC709_LUMINANCE))
    return replace(light, radiance=radiance.astype(np.float32)), tuple(lights)


def _peak_around(
    radiance: Floats, directions: Floats, solid_angles: Floats, centre: Floats
) -> tuple[DirectionalLight, slice, Floats] | None:
    """The excess of ``radiance`` over its surroundings near ``centre``, and the rows of the map without it."""
    for _ in range(3):  # the brightest texel is not the middle of a lamp: move to the mean of what is found
        rows = _rows_within(len(radiance), centre, _RING)
        cosine = directions[rows] @ centre
        inside, ring = cosine > np.cos(_CAP), (cosine <= np.cos(_CAP)) & (cosine > np.cos(_RING))
        if not inside.any() or not ring.any():  # a map too coarse to hold a sun
            return None
        background = np.median(radiance[rows][ring], axis=0)
        # through float32, as the sky will be kept: the sun takes what rounding leaves, so nothing is lost
        sky = np.where(inside[..., None], np.minimum(radiance[rows], background), radiance[rows])
        sky = sky.astype(np.float32).astype(np.float64)
        flux = np.where(inside[..., None], (radiance[rows] - sky) * solid_angles[rows, None, None], 0)
        weight = flux @ REC709_LUMINANCE
        mean = np.einsum("hw,hwc->c", weight, directions[rows])
        if not np.linalg.norm(mean) > 0:
            return None
        centre = mean / np.linalg.norm(mean)
    # 1 − cos θ ≈ θ²/2, and the sum of unit vectors is shorter by its mean: no arccos of what is nearly one
    spread = np.sqrt(max(2 * (1 - np.linalg.norm(mean) / weight.sum()), 0))
    return DirectionalLight(centre, flux.sum((0, 1)), float(spread)), rows, sky


def _rows_within(height: int, centre: Floats, angle: float) -> slice:
    """The rows of a lat-long map that come within ``angle`` of ``centre``."""
    polar = np.arccos(np.clip(centre[1], -1, 1))
    first, last = (polar - angle) / np.pi * height, (polar + angle) / np.pi * height
    return slice(max(int(np.floor(first)), 0), min(int(np.ceil(last)) + 1, height))
