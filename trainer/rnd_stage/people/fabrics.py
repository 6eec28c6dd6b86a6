"""Procedural fabrics: linear colour [N, 3], roughness [N] and relief [N] m as functions of cloth coordinates.

``u`` is around the body or limb, ``v`` along it, both in metres of the template's rest pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Colour = tuple[float, float, float]
Look = tuple[Floats, Floats, Floats]
Kind = Literal["plaid", "print", "denim", "knit", "stripes", "dots", "plain"]


@dataclass(frozen=True)
class Fabric:
    """A kind of fabric, its three linear colours, and the scale of its pattern."""

    kind: Kind
    ground: Colour
    second: Colour
    accent: Colour
    scale: float = 1.0


def weave(fabric: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """The look of ``fabric`` at ``u``, ``v`` [N]."""
    u, v = u / fabric.scale, v / fabric.scale
    kinds = {"plaid": _plaid, "print": _print, "denim": _denim, "knit": _knit, "stripes": _stripes, "dots": _dots}
    colour, roughness, relief = kinds.get(fabric.kind, _plain)(fabric, u, v, seed)
    return colour, roughness, relief * fabric.scale


def blend(colour: Floats, over: Floats | Colour, amount: NDArray[np.floating]) -> Floats:
    """``colour`` [N, 3] mixed with ``over`` by ``amount`` [N]."""
    return colour + amount[:, None] * (np.asarray(over, np.float64) - colour)


def band(value: Floats, centre: float, width: float, soft: float = 0.003) -> Floats:
    """1 within ``width`` around ``centre``, with soft edges."""
    return np.clip((width / 2 - np.abs(value - centre)) / soft + 0.5, 0, 1)


def mottle(u: Floats, v: Floats, size: float) -> Floats:
    """A smooth, irregular pattern in [-1, 1] with features of about ``size`` metres."""
    a, b = u / size, v / size
    return np.sin(2.1 * a + 1.3 * np.sin(1.7 * b)) * np.sin(2.3 * b + 1.1 * np.sin(1.9 * a) + 1) * 0.7 + 0.3 * np.sin(
        5.3 * a - 4.1 * b + 2 * np.sin(3 * a)
    )


def _filled(colour: Colour, like: Floats) -> Floats:
    return np.broadcast_to(np.array(colour, np.float64), (len(like), 3)).copy()


def _plaid(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """A sett of 84 mm: broad stripes in both directions, darker where they cross, and a fine accent."""
    del seed

    def threads(t: Floats) -> tuple[Floats, Floats]:
        t = np.mod(t, 0.084)
        return np.maximum(band(t, 0.018, 0.024), 0.8 * band(t, 0.042, 0.008)), band(t, 0.066, 0.005)

    (broad_u, fine_u), (broad_v, fine_v) = threads(u), threads(v)
    colour = _filled(f.ground, u)
    colour = blend(blend(colour, f.second, 0.55 * broad_u), f.second, 0.55 * broad_v)
    colour = blend(colour, f.accent, 0.75 * np.maximum(fine_u, fine_v))
    twill = 1 + 0.06 * np.sin(900 * (u + v))
    return colour * twill[:, None], 0.82 - 0.06 * np.maximum(broad_u, broad_v), np.zeros(len(u))


def _print(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """Five-petalled flowers of two colours with leaves, one in each jittered cell of 62 mm; ink is smoother."""
    cell = 0.062
    row = np.floor(v / cell)
    shifted = u / cell + 0.5 * np.mod(row, 2)
    column = np.floor(shifted)
    jitter = [_hash(column, row, seed + k) for k in range(5)]
    x = (shifted - column - 0.5) * cell - 0.012 * (jitter[0] - 0.5)
    y = (v / cell - row - 0.5) * cell - 0.012 * (jitter[1] - 0.5)
    radius, angle = np.hypot(x, y), np.arctan2(y, x) + 2 * np.pi * jitter[2]
    size = 0.016 + 0.008 * jitter[3]
    petals = np.clip((size * (0.72 + 0.28 * np.cos(5 * angle)) - radius) / 0.002 + 0.5, 0, 1)
    heart = np.clip((0.28 * size - radius) / 0.002 + 0.5, 0, 1)
    leaf = np.abs(np.mod(angle, 2 * np.pi / 3) - np.pi / 3) * radius
    leaves = np.clip((0.004 - leaf) / 0.002 + 0.5, 0, 1) * (radius < 1.55 * size) * (radius > 0.5 * size)
    colour = _filled(f.ground, u)
    green = np.array([0.07, 0.16, 0.06])
    colour = blend(colour, green, 0.85 * leaves)
    flower = np.where(jitter[4][:, None] < 0.6, f.second, f.accent)
    colour = colour + petals[:, None] * (flower - colour)
    colour = blend(colour, (0.62, 0.42, 0.06), heart)
    return colour * (1 + 0.03 * mottle(u, v, 0.02))[:, None], 0.72 - 0.24 * petals, np.zeros(len(u))


def _denim(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """Twill of blue over white, unevenly washed; paler parts are smoother."""
    wash = np.clip(0.25 + 0.30 * mottle(u + seed, v, 0.09) + 0.22 * mottle(3 * u, v, 0.02), 0, 1)
    colour = blend(_filled(f.ground, u), f.second, 0.55 * wash)
    twill = 1 + 0.10 * np.sin(700 * (u + v)) * np.sin(260 * v)
    return colour * twill[:, None], 0.82 - 0.14 * wash, 0.0004 * mottle(u, v, 0.03)


def _knit(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """Cables of two strands, 62 mm apart, between ribs; hollows are darker."""
    del seed
    t = np.mod(u, 0.062) - 0.031
    phase = 2 * np.pi * v / 0.085
    strands = [np.exp(-(((t - 0.009 * np.sin(phase + shift)) / 0.0060) ** 2)) for shift in (0, np.pi)]
    cable = np.maximum(*strands)
    ribs = 0.5 + 0.5 * np.cos(2 * np.pi * t / 0.0103)
    outside = np.clip((np.abs(t) - 0.017) / 0.004, 0, 1)
    relief = 0.0045 * cable * (1 - outside) + 0.0016 * ribs * outside
    stitches = 0.5 + 0.5 * np.cos(2 * np.pi * (v / 0.012 + np.abs(np.mod(u / 0.012, 1) - 0.5)))
    height = np.clip(relief / 0.0045, 0, 1)
    colour = _filled(f.ground, u) * (0.62 + 0.38 * height + 0.10 * stitches)[:, None]
    return blend(colour, f.second, 0.25 * (height > 0.8)), 0.92 - 0.10 * height, relief


def _stripes(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """Broad and narrow stripes around the body; the accent is a satin yarn."""
    del seed
    t = np.mod(v, 0.110)
    broad, narrow = band(t, 0.030, 0.036), band(t, 0.078, 0.010)
    colour = blend(blend(_filled(f.ground, u), f.second, broad), f.accent, narrow)
    return colour * (1 + 0.04 * mottle(u, v, 0.015))[:, None], 0.80 - 0.35 * narrow, np.zeros(len(u))


def _dots(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """Glossy dots of 14 mm, every fourth in the accent."""
    cell = 0.036
    row = np.floor(v / cell)
    shifted = u / cell + 0.5 * np.mod(row, 2)
    column = np.floor(shifted)
    radius = cell * np.hypot(shifted - column - 0.5, v / cell - row - 0.5)
    dot = np.clip((0.0075 - radius) / 0.002 + 0.5, 0, 1)
    ink = np.where(_hash(column, row, seed)[:, None] < 0.75, f.second, f.accent)
    colour = _filled(f.ground, u)
    return colour + dot[:, None] * (ink - colour), 0.75 - 0.35 * dot, np.zeros(len(u))


def _plain(f: Fabric, u: Floats, v: Floats, seed: int) -> Look:
    """One colour, heathered."""
    fleck = mottle(u + 0.3 * seed, v, 0.006) * 0.6 + 0.4 * mottle(u, v, 0.05)
    return blend(_filled(f.ground, u), f.second, 0.12 * (1 + fleck)), 0.80 + 0.05 * fleck, np.zeros(len(u))


def _hash(column: Floats, row: Floats, seed: int) -> Floats:
    """A number in [0, 1) for every cell."""
    mixed = np.sin(127.1 * column + 311.7 * row + 74.7 * seed) * 43758.5453
    return mixed - np.floor(mixed)
