"""What people wear, as distance fields over the template's rest pose: offset, flared, cut off at hems.

Everything is written for ``.person.person``; a subject's own shape is a warp of the finished surface. Points are in
metres, distances negative inside, as in ``.solids``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .person import person
from .solids import SolidModel, smooth_min

Floats = NDArray[np.float64]

SKIN, TOP, BOTTOM, SHOES, HAIR = range(5)
Collar = Literal["crew", "shirt", "v", "turtle", "hood"]
Cut = Literal["trousers", "shorts", "skirt"]
HairStyle = Literal["short", "bob", "long", "bun", "cap"]

ARM_STARTS = 0.195  # |x| m beyond which a top is sleeve
HEM_ROLL = 0.0025  # m that the last 18 mm of a garment stand out: the folded, sewn edge


@dataclass(frozen=True)
class Garments:
    """The cut of a person's clothes; heights y and reaches |x| in metres of the template's T-pose."""

    loose: float = 0.012
    """how far the top stands off"""
    hang: float = 0.012
    """how much farther it does below the waist"""
    hem: float = 0.90
    """height of the top's lower edge; below 0.85 it falls as a skirt"""
    sleeve: float = 0.672
    """reach of the sleeves"""
    cuff: float = 0.004
    """extra width of the sleeves' ends"""
    collar: Collar = "crew"
    cut: Cut = "trousers"
    leg: tuple[float, float, float] = (0.009, 0.012, 0.024)
    """how far trousers stand off at hip, knee and cuff"""
    leg_hem: float = 0.052
    """height of the trousers', shorts' or skirt's lower edge"""
    flare: float = 0.10
    """how much wider a skirt is at its hem than at the hip"""
    shell: float = 0.010
    """thickness of a skirt, which has air inside; no less than 1.7 steps of the mesh"""
    shoe: float = 0.092
    """height of the shoes"""
    hair: HairStyle = "short"


def ramp(value: Floats, start: float | Floats, end: float | Floats) -> Floats:
    """Smoothly from 0 at ``start`` to 1 at ``end``."""
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def layers(points: Floats, cut: Garments) -> Floats:
    """Distances [N, 5] to SKIN, TOP, BOTTOM, SHOES and HAIR."""
    return np.stack(
        [person().distance(points), top(points, cut), bottom(points, cut), shoes(points, cut), hair(points, cut)],
        axis=1,
    )


def neck_opening(points: Floats) -> Floats:
    """Distance [N] to the upright elliptic cylinder that cuts a collar."""
    across, along = points[:, 0] / 0.084, (points[:, 2] + 0.024) / 0.075
    return np.maximum(0.075 * (np.hypot(across, along) - 1.0), 1.39 - points[:, 1])


def hem_height(points: Floats, cut: Garments) -> Floats:
    """The top's lower edge [N], a little lower before and behind."""
    return cut.hem + 0.010 * np.cos(2 * np.arctan2(points[:, 0], points[:, 2]))


def top(points: Floats, cut: Garments) -> Floats:
    """Shirt, sweater, hoodie, tunic or dress."""
    x, y = np.abs(points[:, 0]), points[:, 1]
    covered = person().distance(points, {"torso", "leg", "arm", "neck"})
    hem = hem_height(points, cut)
    hanging = cut.hang * (ramp(y, 1.18, 0.92) + np.exp(-(((y - 1.09) / 0.10) ** 2))) * (x < 0.3)
    edge = np.maximum(ramp(y, hem + 0.020, hem + 0.014) * (x < 0.3), ramp(x, cut.sleeve - 0.020, cut.sleeve - 0.014))
    shape = covered - cut.loose - hanging - cut.cuff * ramp(x, 0.30, cut.sleeve) - HEM_ROLL * edge
    if cut.collar == "turtle":
        tube = person().distance(points, {"neck"}) - 0.011
        shape = smooth_min(shape, np.maximum(tube, np.abs(y - 1.485) - 0.045), 0.012)
    if cut.hem < 0.85:
        shape = _cut_off(shape, 0.97 - y)
        shape = smooth_min(shape, skirt(points, 1.10, cut.hem, cut), 0.02)
    else:
        shape = _cut_off(shape, hem - y)
    shape = _cut_off(shape, x - cut.sleeve)
    opening = {"crew": 0.0, "shirt": 0.006, "v": 0.004, "turtle": -0.10, "hood": 0.010}[cut.collar]
    shape = _cut_off(shape, opening - neck_opening(points))
    if cut.collar in ("shirt", "v"):  # a wedge open to the breast bone
        depth = {"shirt": 1.375, "v": 1.345}[cut.collar]
        wedge = np.maximum(x - 0.45 * (y - depth), 0.02 - points[:, 2])
        shape = _cut_off(shape, -wedge, 0.004)
    if cut.collar == "shirt":
        shape = smooth_min(shape, _stand_collar(points), 0.004)
    if cut.collar == "hood":
        shape = smooth_min(shape, _hood(points), 0.02)
    return shape


def bottom(points: Floats, cut: Garments) -> Floats:
    """Trousers, shorts or a skirt, up to just under the top: what is covered could only come through it."""
    return _cut_off(_whole_bottom(points, cut), points[:, 1] - cut.hem - 0.03)


def _whole_bottom(points: Floats, cut: Garments) -> Floats:
    y, z = points[:, 1], points[:, 2]
    if cut.cut == "skirt":
        return skirt(points, 1.04, cut.leg_hem, cut)
    legs = person().distance(points, {"torso", "leg"})
    wide = np.interp(y, [0.08, 0.42, 0.70, 0.95], [cut.leg[2], cut.leg[1], cut.leg[0], cut.leg[0]])
    slope = 0.25 if cut.leg_hem < 0.2 else 0.05
    edge = cut.leg_hem - slope * (z + 0.02)
    shape = legs - wide - HEM_ROLL * ramp(y, edge + 0.024, edge + 0.018)
    shape = _cut_off(shape, edge - y, 0.005)
    return _cut_off(shape, y - 1.03, 0.005)


def skirt(points: Floats, waist: float, hem: float, cut: Garments) -> Floats:
    """A pleated cone with air inside, from ``waist`` to ``hem``."""
    flare = cut.flare
    x, y, z = points.T
    t = np.clip((waist - y) / (waist - hem), 0, 1)
    angle = np.arctan2(x, z)
    pleats = 0.012 * t * np.cos(11 * angle + 0.8 * np.sin(2 * angle)) * min(1.0, flare / 0.1)
    half_x = np.interp(y, [hem, 0.90, 1.00, 1.10], [0.190 + flare, 0.192, 0.172, 0.152]) + pleats
    half_z = np.interp(y, [hem, 0.90, 1.00, 1.10], [0.135 + flare, 0.134, 0.118, 0.104]) + pleats
    outside = (np.hypot(x / half_x, (z + 0.004) / half_z) - 1) * np.minimum(half_x, half_z)
    outside -= HEM_ROLL * ramp(y, hem + 0.024, hem + 0.018)
    hips = person().distance(points, {"torso", "leg"}) - 0.010 + np.maximum(0.84 - y, 0)
    outside = smooth_min(outside, hips, 0.03)
    shell = np.maximum(outside, -(outside + cut.shell))
    return _cut_off(_cut_off(shell, hem - y, 0.004), y - waist, 0.004)


def shoes(points: Floats, cut: Garments) -> Floats:
    """An upper of the wanted height on a sole."""
    y, z = points[:, 1], points[:, 2]
    parts = {"foot", "leg"}
    upper = person().distance(points, parts) - 0.010
    upper = _cut_off(upper, y - cut.shoe)
    outline = person().distance(np.stack([points[:, 0], np.full_like(y, 0.022), z], axis=1), {"foot"}) - 0.014
    sole = -smooth_min(-outline, -(np.abs(y - 0.004) - 0.017), 0.006)
    return smooth_min(upper, sole, 0.004)


def hair(points: Floats, cut: Garments) -> Floats:
    """A shell of strands; longer styles add a mass behind, "cap" is a woollen cap."""
    x, y, z = points.T
    skull = person().distance(points, {"head"})
    if cut.hair == "cap":
        thick = 0.016 + 0.006 * ramp(y, 1.668, 1.660) + 0.004 * np.cos(2 * np.pi * np.arctan2(x, z) / 0.14) * 0.4
        line = 1.645 + 0.15 * np.clip(z + 0.02, -0.02, 0.10)
        return _cut_off(skull - thick - 0.02 * ramp(y, 1.70, 1.78), line - y, 0.010)
    crown = ramp(y, 1.62, 1.74)
    strands = 0.0035 * np.sin(95 * x + 30 * np.sin(25 * z)) * np.cos(70 * z + 40 * y) * crown
    volume = {"short": 0.009, "bob": 0.014, "long": 0.012, "bun": 0.007}[cut.hair]
    cap = skull - (volume + 0.015 * crown + 0.006 * ramp(z, 0.05, 0.09) * crown) - strands
    line = np.interp(
        z, [-0.11, -0.08, -0.045, -0.012, 0.012, 0.035, 0.062, 0.10], [1.54, 1.55, 1.58, 1.655, 1.64, 1.668, 1.70, 1.71]
    )
    line = line + 0.006 * np.sin(120 * x + 2.0) * (z > 0.03)  # an uneven fringe
    shape = -smooth_min(-cap, -0.8 * (line - y), 0.010)
    if cut.hair == "bun":
        bun = np.linalg.norm((points - [0, 1.735, -0.085]) / [1.0, 0.9, 0.9], axis=1) - 0.046
        return smooth_min(shape, bun + 0.003 * np.sin(150 * x + 90 * y), 0.012)
    if cut.hair in ("bob", "long"):
        shape = smooth_min(shape, _mane(points, {"bob": 1.53, "long": 1.36}[cut.hair]), 0.02)
    return shape


def _mane(points: Floats, end: float) -> Floats:
    """Hair that falls behind the ears and over the nape down to ``end``."""
    x, y, z = points.T
    mass = SolidModel()
    mass.loft(
        "hair",
        "y",
        [
            (end, 0, 0.070, -0.125, -0.060, 2.0),
            (end + 0.03, 0, 0.086, -0.136, -0.044, 2.2),
            (1.58, 0, 0.098, -0.128, 0.010, 2.4),
            (1.64, 0, 0.097, -0.128, 0.016, 2.4),
            (1.72, 0, 0.080, -0.110, 0.010, 2.2),
        ],
        0.01,
    )
    strands = 0.003 * np.sin(170 * x + 40 * np.sin(9 * y)) + 0.002 * np.sin(260 * z + 30 * x + 12 * y)
    face = np.maximum(np.abs(x) - 0.073, 0.0) - 0.9 * np.maximum(z - 0.002, 0)  # the cheeks stay free
    return np.maximum(mass.distance(points) - strands, -(face + 0.004) * (z > 0.002))


def _stand_collar(points: Floats) -> Floats:
    """The folded band around the neck of a shirt, open in front."""
    x, y, z = points.T
    height = y - 1.452 - 0.18 * np.clip(-z - 0.02, -0.08, 0.06)
    ring = np.abs(neck_opening(np.stack([x, np.maximum(y, 1.45), z], axis=1)) - 0.004 + 0.30 * height) - 0.0045
    gap = 0.010 + 0.55 * np.clip(1.47 - y, 0, 0.04) - np.abs(x) - 10.0 * (z < 0)
    return np.maximum(np.maximum(ring, np.abs(height) - 0.021), gap)


def _hood(points: Floats) -> Floats:
    """A hood that lies on the shoulders: a thick half ring around the nape."""
    x, y, z = points.T
    centre = np.stack([0 * x, 1.462 - 0.35 * np.clip(z + 0.03, -0.07, 0.10), 0 * z - 0.035], axis=1)
    around = np.hypot(x / 1.25, z + 0.035)
    tube = np.hypot(around - 0.080, 1.15 * (y - centre[:, 1])) - np.interp(z, [-0.12, 0.05], [0.036, 0.016])
    return np.maximum(tube, z - 0.075)


def _cut_off(shape: Floats, beyond: Floats, round_edge: float = 0.006) -> Floats:
    """``shape`` without where ``beyond`` is positive, with a rounded edge."""
    return -smooth_min(-shape, -beyond, round_edge)
