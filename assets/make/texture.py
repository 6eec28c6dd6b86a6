"""Albedo and roughness of the dressed figure, as functions of the rest position."""

from __future__ import annotations

import numpy as np

from rnd_stage.people.remesh import Floats

from .clothes import HAIR, SHIRT, SHOES, SKIN, TROUSERS, Dressed, neck_opening, ramp

TEAL = np.array([0.035, 0.16, 0.20])
CREAM = np.array([0.70, 0.64, 0.50])
RUST = np.array([0.52, 0.12, 0.045])
MUSTARD = np.array([0.68, 0.42, 0.07])
DENIM = np.array([0.075, 0.125, 0.27])
WORN = np.array([0.24, 0.33, 0.50])
FLESH = np.array([0.50, 0.295, 0.205])
LIPS = np.array([0.40, 0.15, 0.13])
BROWN = np.array([0.060, 0.038, 0.025])
WHITE = np.array([0.74, 0.73, 0.70])
RED = np.array([0.46, 0.045, 0.04])


def paint(dressed: Dressed) -> tuple[Floats, Floats]:
    """Linear base colour [V, 3] in [0.03, 0.80] and perceptual roughness [V]."""
    p, material = dressed.vertices, dressed.material
    colour, roughness = np.zeros_like(p), np.zeros(len(p))
    for kind, brush in ((SKIN, _skin), (SHIRT, _shirt), (TROUSERS, _trousers), (SHOES, _shoes), (HAIR, _hair)):
        here = material == kind
        colour[here], roughness[here] = brush(p[here])
    return np.clip(colour, 0.03, 0.80), np.clip(roughness, 0.2, 0.95)


def _blend(colour: Floats, over: Floats, amount: Floats) -> Floats:
    return colour + amount[:, None] * (over - colour)


def _band(value: Floats, centre: float, width: float, soft: float = 0.003) -> Floats:
    """1 within ``width`` metres around ``centre``, with soft edges."""
    return np.clip((width / 2 - np.abs(value - centre)) / soft + 0.5, 0, 1)


def _mottle(p: Floats, scale: float) -> Floats:
    """A smooth pattern in [-1, 1] with features of about ``scale`` metres."""
    x, y, z = (p / scale).T
    return np.sin(2.1 * x + 1.3 * np.sin(1.7 * y)) * np.sin(2.3 * y + 1.1 * np.sin(1.9 * z)) * np.sin(2.2 * z + x + 1)


def _skin(p: Floats) -> tuple[Floats, Floats]:
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    face = (z > 0.05) & (y > 1.5)
    colour = FLESH * (1 + 0.06 * _mottle(p, 0.03))[:, None]
    colour = _blend(
        colour, FLESH * [1.08, 0.80, 0.78], 0.6 * np.exp(-((x - 0.045) ** 2 + (y - 1.605) ** 2) / 3e-4) * face
    )
    colour = _blend(colour, FLESH * 0.62, 0.5 * ramp(y, 1.585, 1.55) * face)  # a shaved chin
    lips = np.clip(1.4 - ((x / 0.022) ** 2 + ((y - 1.568) / 0.011) ** 2), 0, 1) * (z > 0.07)
    colour = _blend(colour, LIPS, lips)
    eye = np.clip(2 - 1.6 * (((x - 0.031) / 0.0125) ** 2 + ((y - 1.636) / 0.0055) ** 2), 0, 1) * (z > 0.06)
    colour = _blend(colour, WHITE, eye)
    iris = np.clip(2 - 1.5 * (((x - 0.031) / 0.0065) ** 2 + ((y - 1.636) / 0.0062) ** 2), 0, 1) * (z > 0.06)
    colour = _blend(colour, BROWN, iris)
    brow = _band(y - 0.10 * (x - 0.03), 1.656, 0.009) * _band(x, 0.032, 0.034) * (z > 0.05)
    colour = _blend(colour, BROWN * 1.5, 0.9 * brow)
    nails = (np.abs(p[:, 0]) > 0.84) & (y > 1.39)
    colour = _blend(colour, FLESH * [1.15, 1.05, 1.0], 0.6 * nails)
    return colour, 0.45 - 0.1 * np.maximum(lips, eye) + 0.04 * _mottle(p, 0.02)


def _shirt(p: Floats) -> tuple[Floats, Floats]:
    x, y, z = p.T
    sleeve = np.abs(x) > 0.195
    along = np.where(sleeve, 1.42 - np.abs(x) + 0.195, y)  # stripes run on from the shoulder down the arm
    phase = np.mod(along, 0.130)
    stripe = _band(phase, 0.022, 0.030) + _band(phase, 0.082, 0.030)
    colour = np.broadcast_to(TEAL, p.shape)
    colour = _blend(colour, CREAM, np.clip(stripe, 0, 1))
    colour = _blend(colour, RUST, _band(phase, 0.052, 0.020))
    across = np.where(sleeve, 0.05 * np.arctan2(z + 0.02, y - 1.416), 0.143 * np.arctan2(x, z))
    check = _band(np.mod(across + 0.045, 0.09), 0.045, 0.016)
    colour = _blend(colour, MUSTARD * 0.8, 0.45 * check)
    colour, printed = _prints(colour, p)
    trim = np.maximum(ramp(np.abs(x), 0.632, 0.640), ramp(y, 0.942, 0.934) * (np.abs(x) < 0.3))
    collar = ramp(neck_opening(p), 0.026, 0.022) * (y > 1.38)
    colour = _blend(colour, TEAL * 0.55, np.maximum(trim, collar))
    seam = _band(np.abs(x), 0.193, 0.007) * (y > 1.3)
    colour = _blend(colour, TEAL * 0.5, 0.8 * seam)
    weave = 1 + 0.05 * np.sin(900 * x) * np.sin(900 * y) + 0.06 * _mottle(p, 0.015)
    return colour * weave[:, None], 0.80 - 0.38 * printed


def _prints(colour: Floats, p: Floats) -> tuple[Floats, Floats]:
    """A star in a disc on the chest, a sun behind mountains on the back; both smoother than the cloth."""
    x, y, z = p.T
    front = (z > 0.02) & (np.abs(x) < 0.15)
    radius, angle = np.hypot(x, y - 1.27), np.arctan2(x, y - 1.27)
    disc = np.clip((0.088 - radius) / 0.003, 0, 1) * front
    star = np.clip((0.048 + 0.026 * np.cos(5 * angle) - radius) / 0.003, 0, 1) * front
    colour = _blend(_blend(colour, MUSTARD, disc), TEAL * 0.8, star)
    back = (z < -0.03) & (np.abs(x) < 0.16)
    height = y - 1.23
    radius = np.hypot(x, height - 0.02)
    field = np.clip((0.125 - radius) / 0.003, 0, 1) * back
    ring = _band(radius, 0.120, 0.014) * back
    sun = np.clip((0.045 - np.hypot(x - 0.03, height - 0.055)) / 0.003, 0, 1) * back
    ridge = -0.01 + 0.05 * np.abs(np.mod(x / 0.09 + 0.55, 1.0) - 0.5) * 2
    hills = np.clip((ridge - height) / 0.003, 0, 1) * field
    colour = _blend(_blend(_blend(colour, CREAM, field), RUST, sun), TEAL * 0.9, hills)
    return _blend(colour, MUSTARD, ring), np.maximum(disc, field)


def _trousers(p: Floats) -> tuple[Floats, Floats]:
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    worn = np.exp(-(((y - 0.66) / 0.14) ** 2)) * ramp(z, 0.02, 0.08) + 0.8 * np.exp(-(((y - 0.49) / 0.06) ** 2)) * ramp(
        z, 0, 0.06
    )
    worn += 0.6 * np.exp(-(((y - 0.86) / 0.08) ** 2)) * ramp(z, -0.05, -0.11)
    colour = _blend(np.broadcast_to(DENIM, p.shape), WORN, np.clip(0.75 * worn + 0.10 * _mottle(p, 0.02) + 0.08, 0, 1))
    axis = np.interp(y, [0.05, 0.49, 0.93], [0.131, 0.112, 0.090])
    seam = _band(z + 0.01, 0.0, 0.008) * (x > axis)
    colour = _blend(colour, MUSTARD * 0.7, 0.8 * seam)
    pocket = _band(np.abs(x - 0.085), 0.052, 0.007) * _band(y, 0.875, 0.11) + _band(y, 0.82, 0.007) * _band(
        x, 0.085, 0.10
    )
    colour = _blend(colour, MUSTARD * 0.6, 0.7 * np.clip(pocket, 0, 1) * (z < -0.05))
    cuff = ramp(y + 0.25 * (z + 0.02), 0.090, 0.086)
    colour = _blend(colour, WORN * 1.35, cuff)
    twill = 1 + 0.08 * np.sin(700 * (x + y)) * np.sin(260 * y)
    return colour * twill[:, None], 0.72 + 0.1 * np.clip(worn, 0, 1)


def _shoes(p: Floats) -> tuple[Floats, Floats]:
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    colour = _blend(np.broadcast_to(RED, p.shape), TEAL * 0.5, ramp(z, -0.02, -0.05))
    sole = ramp(y, 0.024, 0.020)
    toe = ramp(z, 0.150, 0.158)
    laces = _band(np.mod(z, 0.022), 0.011, 0.010) * _band(x, 0.138, 0.042) * (z > 0.04) * (z < 0.125) * (y > 0.05)
    colour = _blend(colour, WHITE, np.clip(np.maximum(np.maximum(sole, toe), laces), 0, 1))
    return colour, 0.42 + 0.2 * sole


def _hair(p: Floats) -> tuple[Floats, Floats]:
    x, y, z = p.T
    strands = np.sin(240 * x + 30 * np.sin(25 * z)) * np.sin(90 * z + 60 * y)
    return BROWN * (1.25 + 0.55 * strands)[:, None], np.full(len(p), 0.50)
