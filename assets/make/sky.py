"""Procedural lights, lat-long, linear Rec.709: a noon sky, a low evening sun, a studio with three softboxes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.core.images import write_image
from rnd_runtime.shading.light import texel_directions
from rnd_stage.people.remesh import Floats

HEIGHT, WIDTH = 128, 256
SUBSAMPLES = 8  # per texel and axis, so that the sun's disc has the right area
SUN_RADIUS = np.radians(1.0)  # four times the real one, to cover texels of 1.4°
SUN_RADIANCE = 1.0e4


def direction(azimuth: float, elevation: float) -> Floats:
    """Unit vector; ``azimuth`` in degrees from +X towards +Z, ``elevation`` above the horizon."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])


NOON_SUN = direction(48.0, 42.0)
EVENING_SUN = direction(150.0, 14.0)


def noon() -> Floats:
    """A clear sky [128, 256, 3]: blue above, pale at the horizon, warm sun at ``NOON_SUN``, grey-brown ground."""
    return _sky(
        NOON_SUN,
        sun=SUN_RADIANCE * np.array([1.0, 0.93, 0.82]),
        zenith=np.array([0.22, 0.42, 0.92]),
        horizon=np.array([0.85, 0.98, 1.15]),
        glow=np.array([1.0, 0.92, 0.78]),
        ground=np.array([0.34, 0.29, 0.23]),
    )


def evening() -> Floats:
    """A low orange sun at ``EVENING_SUN`` under a violet sky."""
    return _sky(
        EVENING_SUN,
        sun=0.45 * SUN_RADIANCE * np.array([1.0, 0.56, 0.26]),
        zenith=np.array([0.16, 0.20, 0.48]),
        horizon=np.array([1.10, 0.62, 0.42]),
        glow=np.array([2.2, 1.1, 0.45]),
        ground=np.array([0.14, 0.11, 0.10]),
    )


def studio() -> Floats:
    """A dark room with a warm key light, a wide cool fill and a bright rim light behind."""
    d = texel_directions(HEIGHT * 2, WIDTH * 2)
    radiance = np.full(d.shape, 0.06) * (1.0 + 0.5 * d[..., 1:2])
    boxes = [  # azimuth, elevation, half-widths in degrees, radiance
        (125.0, 38.0, 20.0, 15.0, np.array([15.0, 13.2, 11.0])),
        (30.0, 12.0, 26.0, 22.0, np.array([2.6, 3.1, 3.9])),
        (285.0, 40.0, 12.0, 20.0, np.array([12.0, 12.0, 13.0])),
    ]
    for azimuth, elevation, half_u, half_v, colour in boxes:
        axis = direction(azimuth, elevation)
        right = np.cross(axis, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        ahead = np.maximum(d @ axis, 1e-6)
        u = np.degrees(np.arctan2(np.abs(d @ right), ahead)) / half_u
        v = np.degrees(np.arctan2(np.abs(d @ np.cross(right, axis)), ahead)) / half_v
        edge = np.clip(8.0 * (1.0 - np.maximum(u, v)), 0, 1) * (d @ axis > 0)
        radiance = radiance + edge[..., None] * colour * (1.0 - 0.25 * np.minimum(u * u + v * v, 1))[..., None]
    return radiance.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))


def make_light(path: Path, radiance: Floats) -> None:
    """Write an EXR of 32-bit floats whose mantissas are rounded to 11 bits, which halves the file."""
    bits = radiance.astype(np.float32).view(np.uint32)
    rounded = ((bits + np.uint32(1 << 11)) & ~np.uint32((1 << 12) - 1)).view(np.float32)
    write_image(path, rounded)


def _sky(towards_sun: Floats, *, sun: Floats, zenith: Floats, horizon: Floats, glow: Floats, ground: Floats) -> Floats:
    d = texel_directions(HEIGHT, WIDTH)
    up = d[..., 1:2]
    cosine = np.clip(d @ towards_sun, -1, 1)[..., None]
    clear = zenith + (horizon - zenith) * np.exp(-np.maximum(up, 0) / 0.22)
    halo = glow * (0.9 * np.exp(-np.arccos(cosine) / 0.12) + 0.35 * np.exp(-np.arccos(cosine) / 0.5))
    azimuth = np.arctan2(d[..., 2], d[..., 0])[..., None]
    veil = np.sin(3 * azimuth + 9 * up) * np.sin(5 * azimuth - 14 * up + 1) + 0.6 * np.sin(7 * azimuth + 21 * up + 2)
    veil = np.clip(veil, 0, 1) * np.exp(-(((up - 0.30) / 0.16) ** 2))  # a band of thin cloud
    above = (clear + halo) * (1 - 0.25 * veil) + 0.28 * veil * horizon
    near_horizon = np.exp(np.minimum(up, 0) / 0.06)
    below = ground * (1 + 0.25 * cosine) * (1 - near_horizon) + 0.6 * horizon * near_horizon
    radiance = np.where(up > 0, above, below)
    return radiance + _disc_coverage(towards_sun)[..., None] * sun


def _disc_coverage(centre: Floats) -> Floats:
    """The share [128, 256] of every texel's solid angle that the sun's disc covers."""
    inside = texel_directions(HEIGHT * SUBSAMPLES, WIDTH * SUBSAMPLES) @ centre > np.cos(SUN_RADIUS)
    return inside.reshape(HEIGHT, SUBSAMPLES, WIDTH, SUBSAMPLES).mean(axis=(1, 3))
