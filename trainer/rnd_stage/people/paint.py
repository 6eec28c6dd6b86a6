"""Albedo, roughness and relief of a dressed person, as functions of the template's rest position."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .fabrics import Colour, Fabric, Look, band, blend, mottle, weave
from .garments import ARM_STARTS, BOTTOM, HAIR, SHOES, SKIN, TOP, Garments, hem_height, neck_opening, ramp

Floats = NDArray[np.float64]

ALBEDO_RANGE = (0.03, 0.80)
ROUGHNESS_RANGE = (0.25, 0.95)
THREAD = np.array([0.50, 0.30, 0.06])  # the yellow of jeans' seams


@dataclass(frozen=True)
class Palette:
    """What a person's surfaces are made of."""

    top: Fabric
    bottom: Fabric
    skin: Colour = (0.50, 0.295, 0.205)
    hair: Colour = (0.060, 0.038, 0.025)
    shoe: Colour = (0.46, 0.045, 0.04)
    sole: Colour = (0.72, 0.71, 0.68)
    lips: Colour = (0.40, 0.15, 0.13)
    beard: float = 0.0
    """0 shaved, 1 full"""
    buttons: bool = False
    """down the front of the top"""
    seed: int = field(default=0)


def paint(points: Floats, material: NDArray[np.int64], garments: Garments, palette: Palette) -> Look:
    """Linear albedo [V, 3], roughness [V] and relief along the normals [V] m at rest positions ``points`` [V, 3]."""
    colour, roughness, relief = np.zeros_like(points), np.zeros(len(points)), np.zeros(len(points))
    for kind, brush in ((SKIN, _skin), (TOP, _top), (BOTTOM, _bottom), (SHOES, _shoes), (HAIR, _hair)):
        here = material == kind
        if here.any():
            colour[here], roughness[here], relief[here] = brush(points[here], garments, palette)
    return np.clip(colour, *ALBEDO_RANGE), np.clip(roughness, *ROUGHNESS_RANGE), relief


def _top(p: Floats, garments: Garments, palette: Palette) -> Look:
    x, y, z = p.T
    reach = np.abs(x)
    sleeve = (reach > ARM_STARTS) & (y > 1.2)
    shoulder = ramp(y, 1.30, 1.46) * (ARM_STARTS - 0.04 - reach)  # level there: height alone would smear the pattern
    along = np.where(sleeve, 1.42 - reach + ARM_STARTS, y + shoulder)  # it runs on from the shoulder down the arm
    around = np.where(sleeve, 0.058 * np.arctan2(z + 0.02, y - 1.416), 0.150 * np.arctan2(x, z))
    colour, roughness, relief = weave(palette.top, around, along, palette.seed)
    ground = np.array(palette.top.ground)
    hem = hem_height(p, garments)
    edge = np.maximum(
        ramp(y, hem + 0.022, hem + 0.016) * ~sleeve, ramp(reach, garments.sleeve - 0.022, garments.sleeve - 0.016)
    )
    collar = ramp(neck_opening(p), 0.020, 0.016) * (y > 1.38)
    ribbed = palette.top.kind in ("knit", "plain", "stripes")
    trim = np.maximum(edge, collar)
    colour = blend(colour, 0.72 * ground + 0.02, trim * (0.8 if ribbed else 0.25))
    if ribbed:
        ribs = 0.5 + 0.5 * np.cos(2 * np.pi * around / 0.008)
        relief = relief * (1 - trim) + 0.0012 * ribs * trim
    stitch = np.maximum(band(y - hem, 0.019, 0.0035) * ~sleeve, band(reach, garments.sleeve - 0.019, 0.0035))
    seam = np.maximum(
        band(reach, ARM_STARTS - 0.002, 0.004) * (y > 1.3), band(z + 0.012, 0, 0.004) * ~sleeve * (y < 1.33)
    )
    lines = np.maximum(stitch, seam)
    colour, relief = blend(colour, 0.55 * ground, 0.7 * lines), relief - 0.0008 * lines
    if palette.buttons:
        front = (z > 0) & (y < 1.45)
        placket = band(reach, 0.0, 0.036) * front
        fold = band(reach, 0.018, 0.0035) * front
        colour, relief = blend(colour, 0.5 * ground, 0.75 * fold), relief + 0.0015 * placket - 0.001 * fold
        button = np.clip((0.0062 - np.hypot(x, np.mod(y - hem - 0.05, 0.082) - 0.041)) / 0.0015 + 0.5, 0, 1) * front
        colour, roughness = blend(colour, (0.66, 0.62, 0.52), button), roughness - 0.5 * button
        pocket = band(reach - 0.078, 0, 0.098, 0.002) * band(y, 1.262, 0.108, 0.002) * front
        rim = pocket - band(reach - 0.078, 0, 0.089, 0.002) * band(y, 1.262, 0.099, 0.002) * front
        colour, relief = blend(colour, 0.5 * ground, 0.7 * rim), relief + 0.0015 * pocket
    if garments.collar == "hood":
        pouch = band(reach, 0, 0.26 - 0.5 * np.clip(y - 1.0, 0, 0.1), 0.004) * band(y, 1.015, 0.150, 0.004) * (z > 0)
        rim = pouch - band(reach, 0, 0.245 - 0.5 * np.clip(y - 1.0, 0, 0.1), 0.004) * band(y, 1.015, 0.138, 0.004) * (
            z > 0
        )
        colour, relief = blend(colour, 0.5 * ground, 0.6 * rim), relief + 0.003 * pouch
        cord = band(np.abs(x), 0.030, 0.006) * band(y, 1.33, 0.16, 0.004) * (z > 0.02)
        colour, relief = blend(colour, (0.7, 0.68, 0.62), cord), relief + 0.003 * cord
    return colour, roughness, relief


def _bottom(p: Floats, garments: Garments, palette: Palette) -> Look:
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    if garments.cut == "skirt":
        around = 0.20 * np.arctan2(p[:, 0], z)
        colour, roughness, relief = weave(palette.bottom, around, y, palette.seed + 7)
        stitch = band(y, garments.leg_hem + 0.020, 0.0035) + band(y, 0.995, 0.0035)
        return (blend(colour, 0.55 * np.array(palette.bottom.ground), 0.7 * np.clip(stitch, 0, 1)), roughness, relief)
    axis = np.interp(y, [0.05, 0.49, 0.93], [0.131, 0.112, 0.090])
    around = 0.075 * np.arctan2(x - axis, z + 0.005)
    colour, roughness, relief = weave(palette.bottom, around, y, palette.seed + 7)
    denim = palette.bottom.kind == "denim"
    if denim:  # worn pale over the thighs, knees and seat
        worn = np.exp(-(((y - 0.66) / 0.14) ** 2)) * ramp(z, 0.02, 0.08)
        worn += 0.8 * np.exp(-(((y - 0.49) / 0.06) ** 2)) * ramp(z, 0, 0.06)
        worn += 0.6 * np.exp(-(((y - 0.86) / 0.08) ** 2)) * ramp(z, -0.05, -0.11)
        worn = np.clip(0.8 * worn, 0, 1)
        colour, roughness = blend(colour, palette.bottom.second, 0.75 * worn), roughness - 0.12 * worn
    thread = THREAD if denim else 0.5 * np.array(palette.bottom.ground)
    side = band(z + 0.01, 0.0, 0.005) * (x > axis)
    inside = band(z + 0.01, 0.0, 0.004) * (x < axis) * (y < 0.84)
    edge = garments.leg_hem - (0.25 if garments.leg_hem < 0.2 else 0.05) * (z + 0.02)
    stitch = band(y - edge, 0.021, 0.0035)
    patch = band(x - 0.085, 0, 0.112, 0.002) * band(y, 0.872, 0.125, 0.002) * (z < -0.05)
    rim = patch - band(x - 0.085, 0, 0.103, 0.002) * band(y, 0.872, 0.116, 0.002) * (z < -0.05)
    fly = band(p[:, 0], 0.018, 0.003) * (z > 0.03) * (y > 0.86)
    slant = band(x - 0.115 - 0.35 * (0.95 - y), 0, 0.004) * (z > 0.02) * (y > 0.86)
    lines = np.clip(side + 0.6 * inside + stitch + rim + fly + slant, 0, 1)
    return (blend(colour, thread, 0.75 * lines), roughness + 0.05 * lines, relief - 0.0008 * lines + 0.0015 * patch)


def _skin(p: Floats, garments: Garments, palette: Palette) -> Look:
    del garments
    flesh, dark = np.array(palette.skin), np.array(palette.hair)
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    face = (z > 0.05) & (y > 1.5)
    colour = flesh * (1 + 0.05 * mottle(p[:, 0] + p[:, 2], y, 0.03))[:, None]
    cheek = 0.6 * np.exp(-((x - 0.045) ** 2 + (y - 1.605) ** 2) / 3e-4) * face
    colour = blend(colour, flesh * [1.08, 0.80, 0.78], cheek)
    jaw = ramp(y, 1.590 - 0.3 * np.clip(z - 0.06, -1, 0.04), 1.570) * (z > -0.005) * (y > 1.515) * ramp(x, 0.078, 0.07)
    lip_line = ((x / 0.024) ** 2 + ((y - 1.568) / 0.012) ** 2) > 1.2
    colour = blend(colour, dark * 1.2, palette.beard * 0.92 * jaw * lip_line)
    moustache = band(y, 1.586, 0.010) * band(x, 0, 0.050) * (z > 0.07)
    colour = blend(colour, dark * 1.2, palette.beard * 0.9 * moustache)
    lips = np.clip(1.4 - ((x / 0.022) ** 2 + ((y - 1.568) / 0.0105) ** 2), 0, 1) * (z > 0.07)
    colour = blend(colour, palette.lips, lips)
    eye = np.clip(2 - 1.6 * (((x - 0.031) / 0.0125) ** 2 + ((y - 1.636) / 0.0055) ** 2), 0, 1) * (z > 0.06)
    colour = blend(colour, (0.72, 0.70, 0.67), eye)
    iris = np.clip(2 - 1.5 * (((x - 0.031) / 0.0065) ** 2 + ((y - 1.636) / 0.0062) ** 2), 0, 1) * (z > 0.06)
    colour = blend(colour, (0.05, 0.032, 0.02), iris)
    lid = band(y - 1.6425 + 20 * (x - 0.031) ** 2, 0, 0.003, 0.0015) * band(x, 0.031, 0.028) * (z > 0.06)
    colour = blend(colour, dark * 0.8, 0.8 * lid)
    brow = band(y - 0.10 * (x - 0.03), 1.656, 0.008) * band(x, 0.032, 0.034) * (z > 0.05)
    colour = blend(colour, dark * 1.3, 0.9 * brow)
    nails = (x > 0.84) & (y > 1.39)
    colour = blend(colour, flesh * [1.15, 1.05, 1.0], 0.6 * nails)
    oily = face * np.exp(-((x / 0.025) ** 2)) * (y > 1.58)
    roughness = 0.46 - 0.10 * oily - 0.12 * np.maximum(lips, eye) + 0.03 * mottle(p[:, 0], y + z, 0.02)
    return colour, roughness, np.zeros(len(p))


def _shoes(p: Floats, garments: Garments, palette: Palette) -> Look:
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    leather = np.array(palette.shoe)
    colour = blend(np.broadcast_to(leather, p.shape), 0.55 * leather, ramp(z, -0.02, -0.05))
    sole, toe = ramp(y, 0.024, 0.020), ramp(z, 0.150, 0.158) * (y < 0.045)
    laces = band(np.mod(z, 0.020), 0.010, 0.007) * band(x, 0.138, 0.040) * (z > 0.03) * (z < 0.125) * (y > 0.045)
    front = band(np.mod(y, 0.022), 0.011, 0.007) * band(x, 0.130, 0.036) * (z > 0.0) * (y > 0.085)
    laces = np.maximum(laces, front * (garments.shoe > 0.12))
    rim = ramp(y, garments.shoe - 0.014, garments.shoe - 0.010)
    colour = blend(colour, 0.6 * leather, rim)
    colour = blend(colour, palette.sole, np.maximum(np.maximum(sole, toe), laces))
    return colour, 0.38 + 0.35 * sole + 0.2 * laces, 0.0015 * laces


def _hair(p: Floats, garments: Garments, palette: Palette) -> Look:
    x, y, z = p.T
    if garments.hair == "cap":
        around, along = 0.09 * np.arctan2(x, z), y
        return weave(Fabric("knit", palette.shoe, palette.sole, palette.sole, scale=0.55), around, along, palette.seed)
    locks = np.sin(240 * x + 30 * np.sin(25 * z)) * np.sin(90 * z + 14 * y)
    shine = np.exp(-(((y - 1.735) / 0.02) ** 2))
    colour = np.array(palette.hair) * (1.2 + 0.5 * locks)[:, None]
    return colour, 0.46 + 0.08 * locks - 0.10 * shine, 0.0006 * locks
