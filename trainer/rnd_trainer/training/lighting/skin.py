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

SKIN_CHROMA = np.array([0.50, -0.28])
"""log r/g and log b/g of skin in linear sRGB: means of the two patches, with 3 % of white reflected at the surface"""
SKIN_DEVIATION = 0.1
"""standard deviation of either over people"""
LIGHT_AXES = np.array([[0.595, -0.803], [0.803, 0.595]])
"""unit axes of log r/g and log b/g: from blue to orange, as black bodies of 10 000 to 3 000 K lie, and to magenta"""
LIGHT_DEVIATION = np.array([0.5, 0.08])
"""standard deviation of the mean light along ``LIGHT_AXES``: from overcast sky to candles; lamps are hardly magenta"""
PLAUSIBLE = np.array([[-1.3, 1.5], [-0.35, 0.35]])
"""least and greatest distance from ``SKIN_CHROMA`` along ``LIGHT_AXES`` that may be skin, not a glove or a beard"""
SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION = 0.28, 0.5
"""median reflectance of skin over people, and the deviation of its logarithm"""
BODY_LUMINANCE, BODY_DEVIATION = 0.28, 0.35
"""the same of a clothed person's mean: geometric mean and spread of the seven development subjects"""
BRIGHT_SHARE = 0.95
"""share of the points that are at most as bright as the brightest material; the others may be errors or highlights"""
MIN_POINTS = 8
"""plausible points below which nothing is said"""
TONES = (0.40, 0.34, 0.27, 0.20, 0.14, 0.08)
"""reflectance of skin of Fitzpatrick's types 1 to 6, from their mean CIELAB lightness"""
TONE_DEVIATION = 0.1
"""of the logarithm, within a type"""


def skin_points(template: Template, skeleton: Skeleton) -> NDArray[np.int64]:
    """Indices of the points on hands and face, by skinning weights and rest pose; empty without joints of these names.

    The face is below the hair: the front of the head up to three fifths of its height.
    """
    names = {name: index for index, name in enumerate(skeleton.names)}
    points, normals, weights, joints = template.points, template.normals, template.weights, skeleton.rest_joints
    found = np.zeros(len(points), bool)
    for side in ("left", "right"):
        elbow, wrist = (names.get(f"{side}_{joint}") for joint in ("elbow", "wrist"))
        if elbow is None or wrist is None:
            continue
        along = joints[wrist] - joints[elbow]
        beyond = (points - joints[wrist]) @ (along / np.linalg.norm(along))
        moved = weights[:, _with_children(skeleton, wrist)].sum(1)
        found |= (moved > 0.8) & (beyond > 0.03)  # m, past a sleeve's end
    if (head := names.get("head")) is not None:
        of_head = weights[:, _with_children(skeleton, head)].sum(1) > 0.8
        if of_head.any():
            height = points[:, 1] - joints[head, 1]
            found |= of_head & (normals[:, 2] > 0.6) & (height > 0) & (height < 0.6 * height[of_head].max())
    return np.nonzero(found)[0]


def _with_children(skeleton: Skeleton, joint: int) -> list[int]:
    """``joint`` and all joints below it."""
    below = [joint]
    for child, parent in enumerate(skeleton.parents):
        if parent in below:
            below.append(child)
    return below


def likely_gain(albedo: Floats, weight: Floats, skin: Sequence[int] | NDArray[np.int64], tone: float | None) -> Floats:
    """The factor [3] on all albedos that makes them likeliest, by their mean and by skin where it was seen.

    It leaves the brightest within the range of materials: on a pink shirt that is overexposed the mean is no guide.

    Args:
        albedo: [P, 3] of points under a light that is grey in the mean.
        weight: [P] of their mean, 0 where a point was not seen.
        skin: indices of points that may be skin.
        tone: known reflectance of the skin, or None.
    """
    of_skin = albedo[[p for p in skin if p < len(weight) and weight[p] > 0]]
    logs = np.log(np.maximum(of_skin, 1e-4))
    shifted = (logs[:, [0, 2]] - logs[:, 1:2] - SKIN_CHROMA) @ LIGHT_AXES.T
    plausible = ((shifted > PLAUSIBLE[:, 0]) & (shifted < PLAUSIBLE[:, 1])).all(1)
    known = np.count_nonzero(plausible) >= MIN_POINTS
    colour = np.ones(3)
    if known:
        share = LIGHT_DEVIATION**2 / (LIGHT_DEVIATION**2 + SKIN_DEVIATION**2)
        red, blue = (share * np.median(shifted[plausible], axis=0)) @ LIGHT_AXES
        colour = np.exp([-red, 0, -blue])
    to_luminance = colour * REC709_LUMINANCE
    level = [(np.log(BODY_LUMINANCE / np.average(albedo @ to_luminance, weights=weight)), BODY_DEVIATION)]
    if known:
        expected, deviation = (SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION) if tone is None else (tone, TONE_DEVIATION)
        level.append((np.log(expected) - np.median(np.log(of_skin[plausible] @ to_luminance)), deviation))
    shifts, deviations = np.array(level).T
    gain = np.exp(np.average(shifts, weights=1 / deviations**2)) * colour
    brightest = np.quantile((albedo[weight > 0] * gain).max(1), BRIGHT_SHARE)
    return gain * min(1.0, ALBEDO_RANGE[1] / brightest)
