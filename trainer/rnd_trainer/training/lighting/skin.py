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
from rnd_trainer.model.template import Template

Floats = NDArray[np.float64]

SKIN_CHROMA = np.array([0.50, -0.28])
"""log r/g and log b/g of skin in linear sRGB: means of the two patches, with 3 % of white reflected at the surface"""
SKIN_DEVIATION = np.array([0.10, 0.07])
"""standard deviation of ``SKIN_CHROMA`` over people"""
LIGHT_DEVIATION = np.array([0.12, 0.20])
"""standard deviation of log r/g and log b/g of the mean light: from candles to overcast sky"""
PLAUSIBLE = 0.45
"""largest distance of a point's log chroma from ``SKIN_CHROMA`` that may be skin, not a glove or a beard"""
SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION = 0.28, 0.5
"""median reflectance of skin over people, and the deviation of its logarithm"""
BODY_LUMINANCE, BODY_DEVIATION = 0.28, 0.35
"""the same of a clothed person's mean: geometric mean and spread of the seven development subjects"""
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

    Args:
        albedo: [P, 3] of points under a light that is grey in the mean.
        weight: [P] of their mean, 0 where a point was not seen.
        skin: indices of points that may be skin.
        tone: known reflectance of the skin, or None.
    """
    mean = np.log(np.average(albedo @ REC709_LUMINANCE, weights=weight))
    level = [(np.log(BODY_LUMINANCE) - mean, BODY_DEVIATION)]
    logs = np.log(np.maximum(albedo[[p for p in skin if p < len(weight) and weight[p] > 0]], 1e-4))
    chroma = logs[:, [0, 2]] - logs[:, 1:2]
    plausible = np.linalg.norm(chroma - SKIN_CHROMA, axis=1) < PLAUSIBLE
    red, blue = 0.0, 0.0
    if np.count_nonzero(plausible) >= MIN_POINTS:
        share = LIGHT_DEVIATION**2 / (LIGHT_DEVIATION**2 + SKIN_DEVIATION**2)
        red, blue = share * (SKIN_CHROMA - np.median(chroma[plausible], axis=0))
        seen = np.median(np.log(np.exp(logs[plausible]) @ REC709_LUMINANCE))
        expected = (SKIN_LUMINANCE, SKIN_LUMINANCE_DEVIATION) if tone is None else (tone, TONE_DEVIATION)
        level.append((np.log(expected[0]) - seen, expected[1]))
    shifts, deviations = np.array(level).T
    colour = np.exp([red, 0, blue])
    colour /= colour @ REC709_LUMINANCE
    return np.exp(np.average(shifts, weights=1 / deviations**2)) * colour
