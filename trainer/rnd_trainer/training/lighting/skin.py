"""Skin as a colour reference: hands and face reflect within bounds known for all people, clothes do not.

One image cannot tell a blue shirt in white light from a white shirt in blue light. The chromaticity of skin varies
little over all tones: the ColorChecker's patches "dark skin" and "light skin" lie 0.14 apart in log r/g and 0.07 in
log b/g.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.shading.light import REC709_LUMINANCE
from rnd_trainer.model.model import ALBEDO_RANGE
from rnd_trainer.model.template import Template

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

SKIN_CHROMA = np.array([0.50, -0.28])
"""log r/g and log b/g of skin in linear sRGB: means of the two patches, with 3 % of white reflected at the surface"""
LIGHT_AXES = np.array([[0.595, -0.803], [0.803, 0.595]])
"""unit axes of log r/g and log b/g: from blue to orange, as black bodies of 10 000 to 3 000 K lie, and to magenta"""
SKIN_DEVIATION = np.array([0.1, 0.04])
"""standard deviation of skin over people along ``LIGHT_AXES``; the patches are 0.07 and 0.04 from their mean"""
LIGHT_DEVIATION = np.array([0.5, 0.2])
"""that of the mean light: from overcast sky to candles, from fluorescent lamps to dawn"""
PLAUSIBLE = np.array([[-1.3, 1.5], [-0.35, 0.35]])
"""least and greatest distance from ``SKIN_CHROMA`` along ``LIGHT_AXES`` that may be skin, not a glove or a beard"""
AGREEMENT = 0.2
"""distance along either axis within which hands and face are alike: then they are skin, whatever the light"""
SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION = 0.26, 0.4
"""median reflectance of skin over people, and the deviation of its logarithm"""
BODY_LUMINANCE, BODY_DEVIATION = 0.28, 0.35
"""the same of a clothed person's mean: geometric mean and spread of the seven development subjects"""
BRIGHT_SHARE = 0.95
"""share of the points that are at most as bright as the brightest material; the others may be errors or highlights"""
MIN_POINTS = 8
"""plausible points below which nothing is said"""
MIN_ALIKE = 3
"""points of either place that are compared"""
TONES = (0.40, 0.34, 0.27, 0.20, 0.14, 0.08)
"""reflectance of skin of Fitzpatrick's types 1 to 6, from their mean CIELAB lightness"""
TONE_DEVIATION = 0.1
"""of the logarithm, within a type"""


def skin_points(template: Template, skeleton: Skeleton) -> tuple[Indices, Indices]:
    """Indices of the points on hands and on the face, by skinning weights and rest pose; none without joints so named.

    The face is below the hair: the front of the head up to three fifths of its height.
    """
    names = {name: index for index, name in enumerate(skeleton.names)}
    points, normals, weights, joints = template.points, template.normals, template.weights, skeleton.rest_joints
    hands, face = np.zeros((2, len(points)), bool)
    for side in ("left", "right"):
        elbow, wrist = (names.get(f"{side}_{joint}") for joint in ("elbow", "wrist"))
        if elbow is None or wrist is None:
            continue
        along = joints[wrist] - joints[elbow]
        beyond = (points - joints[wrist]) @ (along / np.linalg.norm(along))
        moved = weights[:, _with_children(skeleton, wrist)].sum(1)
        hands |= (moved > 0.8) & (beyond > 0.03)  # m, past a sleeve's end
    if (head := names.get("head")) is not None:
        of_head = weights[:, _with_children(skeleton, head)].sum(1) > 0.8
        if of_head.any():
            height = points[:, 1] - joints[head, 1]
            face = of_head & (normals[:, 2] > 0.6) & (height > 0) & (height < 0.6 * height[of_head].max())
    return np.nonzero(hands)[0], np.nonzero(face)[0]


def _with_children(skeleton: Skeleton, joint: int) -> list[int]:
    """``joint`` and all joints below it."""
    below = [joint]
    for child, parent in enumerate(skeleton.parents):
        if parent in below:
            below.append(child)
    return below


def likely_gain(albedo: Floats, weight: Floats, skin: Sequence[Indices], tone: float | None) -> Floats:
    """The factor [3] on all albedos that makes them likeliest, by their mean and by skin where it was seen.

    It leaves the brightest within the range of materials: on a pink shirt that is overexposed the mean is no guide.

    Args:
        albedo: [P, 3] of points under a light that is grey in the mean.
        weight: [P] of their mean, 0 where a point was not seen.
        skin: indices of points that may be skin, by place.
        tone: known reflectance of the skin, or None.
    """
    of_skin, shifts = _of_skin([albedo[[p for p in place if p < len(weight) and weight[p] > 0]] for place in skin])
    known = len(of_skin) >= MIN_POINTS
    colour = np.ones(3)
    if known:
        share = LIGHT_DEVIATION**2 / (LIGHT_DEVIATION**2 + SKIN_DEVIATION**2)
        red, blue = (share * np.median(shifts, axis=0)) @ LIGHT_AXES
        colour = np.exp([-red, 0, -blue])
    to_luminance = colour * REC709_LUMINANCE
    level = [(np.log(BODY_LUMINANCE / np.average(albedo @ to_luminance, weights=weight)), BODY_DEVIATION)]
    if known:
        expected, deviation = (SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION) if tone is None else (tone, TONE_DEVIATION)
        level.append((np.log(expected) - np.median(np.log(of_skin @ to_luminance)), deviation))
    factors, deviations = np.array(level).T
    gain = np.exp(np.average(factors, weights=1 / deviations**2)) * colour
    brightest = np.quantile((albedo[weight > 0] * gain).max(1), BRIGHT_SHARE)
    return gain * min(1.0, ALBEDO_RANGE[1] / brightest)


def _of_skin(places: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Albedo [S, 3] of the points that are skin, and their distances [S, 2] from ``SKIN_CHROMA`` along ``LIGHT_AXES``.

    Args:
        places: albedo [P, 3] of what may be skin, by place.
    """
    albedo = np.concatenate([np.empty((0, 3)), *places])
    logs = np.log(np.maximum(albedo, 1e-4))
    shifts = (logs[:, [0, 2]] - logs[:, 1:2] - SKIN_CHROMA) @ LIGHT_AXES.T
    each = np.split(shifts, np.cumsum([len(place) for place in places])[:-1]) if places else []
    medians = [np.median(of_place, axis=0) for of_place in each if len(of_place) >= MIN_ALIKE]
    plausible = ((shifts > PLAUSIBLE[:, 0]) & (shifts < PLAUSIBLE[:, 1])).all(1)
    if len(medians) > 1 and (np.ptp(medians, axis=0) < AGREEMENT).all():
        plausible = (np.abs(shifts - np.mean(medians, axis=0)) < AGREEMENT).all(1)
    return albedo[plausible], shifts[plausible]
