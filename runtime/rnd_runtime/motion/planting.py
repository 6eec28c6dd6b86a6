"""Feet on the ground: how fast planted ones slide, and a correction that keeps them where they are.

A planted foot is moved as a whole against its slide; hip and knee follow by inverse kinematics. The correction fades
before and after the contact.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix

from .motion import Motion
from .skeleton import Skeleton

Floats = NDArray[np.float64]

LEVEL = 5
"""percentile of a foot's height over the clip where it stands"""
HEIGHT, SPEED = (0.025, 0.045), (0.4, 0.8)
"""m above its level and m/s along the ground, up to which a foot is planted and from which it is not"""
SLIDE_HEIGHT = 0.025
"""m, at which a foot no longer counts for the slide"""
FADE = 0.2
"""s, in which a correction falls to a third"""
FARTHEST = 0.08
"""m, largest correction"""
_LEG = ("hip", "knee", "ankle", "foot")
_STRETCH = 0.9995
"""of a leg's length, largest reach"""
_STRAIGHT = 0.15
"""sine of a knee's bend below which its hinge counts"""
_STEPS, _SLOWEST = 6, 0.02
"""steps of the bend, and m/rad, least change of a leg's length that they reckon with"""


def feet_slide(motion: Motion, skeleton: Skeleton) -> float | None:
    """Mean speed in m/s at which feet on the ground move along it; None for a skeleton without legs or one frame.

    A foot at height h above its level counts by 2 − 2^(h / H), as in Zhang et al. 2018, "Mode-Adaptive Neural Networks
    for Quadruped Motion Control".
    """
    legs = _legs(skeleton)
    if not legs or motion.frame_count < 2:
        return None
    joints = skeleton.joint_transforms(motion.rotations, motion.translations)[..., :3, 3][:, [leg[3] for leg in legs]]
    heights = joints[1:, :, 1] - np.percentile(joints[:, :, 1], LEVEL, axis=0)
    weights = 2 - 2 ** np.clip(heights / SLIDE_HEIGHT, 0, 1)
    speeds = np.linalg.norm(np.diff(joints[..., [0, 2]], axis=0), axis=-1) * motion.fps
    return float((weights * speeds).sum() / max(weights.sum(), 1e-12))


def plant_feet(motion: Motion, skeleton: Skeleton) -> Motion:
    """``motion`` with planted feet kept in their places; heights, the root and frames away from contacts stay.

    Raises:
        InputError: the skeleton has no joints hip, knee, ankle and foot of a side.
    """
    legs = _legs(skeleton)
    if not legs:
        raise InputError("--plant-feet", expected="joints left_hip, left_knee, left_ankle, left_foot", got="none")
    posed = skeleton.joint_transforms(motion.rotations, motion.translations)
    rotations = motion.rotations.copy()
    for leg in legs:
        places = posed[:, leg[3], :3, 3]
        copies = 3 if motion.closed else 1  # a contact at the seam is one
        offsets = _offsets(np.tile(places, (copies, 1)), motion.fps)
        middle = copies // 2 * motion.frame_count
        _follow(rotations, posed, leg, skeleton, offsets[middle : middle + motion.frame_count])
    return replace(motion, rotations=rotations)


def _legs(skeleton: Skeleton) -> list[list[int]]:
    """Joints hip, knee, ankle and foot of each side."""
    sides = [[f"{side}_{joint}" for joint in _LEG] for side in ("left", "right")]
    known = [[skeleton.names.index(name) for name in leg] for leg in sides if set(leg) <= set(skeleton.names)]
    chained = [all(skeleton.parents[b] == a for a, b in pairwise(leg)) for leg in known]
    return [leg for leg, whole in zip(known, chained) if whole]


def _offsets(places: Floats, fps: float) -> Floats:
    """Correction [F, 3] m along the ground of a foot at ``places`` [F, 3].

    While it is planted it takes back the foot's own steps, else it fades; the mean of both directions of time.
    """
    steps = np.diff(places, axis=0, prepend=places[:1]) * [1, 0, 1]
    heights = places[:, 1] - np.percentile(places[:, 1], LEVEL)
    low = np.clip((HEIGHT[1] - heights) / (HEIGHT[1] - HEIGHT[0]), 0, 1)
    slow = np.clip((SPEED[1] - np.linalg.norm(steps, axis=-1) * fps) / (SPEED[1] - SPEED[0]), 0, 1)
    planted = np.minimum(low[1:], low[:-1]) * slow[1:]  # of each step
    forth = _taken_back(steps[1:], planted, fps)
    back = _taken_back(-steps[:0:-1], planted[::-1], fps)
    return (forth + back[::-1]) / 2


def _taken_back(steps: Floats, planted: Floats, fps: float) -> Floats:
    """Offsets [F, 3] after F − 1 ``steps`` [F − 1, 3], each taken back by as much as the foot is ``planted``."""
    offsets = np.zeros((len(steps) + 1, 3))
    for frame, (step, share) in enumerate(zip(steps, planted)):
        offset = offsets[frame] * math.exp((share - 1) / (FADE * fps)) - share * step
        length = float(np.linalg.norm(offset))
        offsets[frame + 1] = offset * min(1, FARTHEST / max(length, 1e-12))
    return offsets


def _follow(rotations: Floats, posed: Floats, leg: list[int], skeleton: Skeleton, offsets: Floats) -> None:
    """Turn hip, knee and ankle in ``rotations`` [F, J, 3, 3] so that the foot moves by ``offsets`` and turns not."""
    frames = np.flatnonzero(np.linalg.norm(offsets, axis=-1) > 1e-7)
    if not len(frames):
        return
    hip, knee, ankle, foot = leg
    at_hip, at_knee, at_ankle = (posed[frames, joint, :3, 3] for joint in (hip, knee, ankle))
    of_hip, of_knee, of_ankle = (posed[frames, joint, :3, :3] for joint in (hip, knee, ankle))
    thigh, shin, target = at_knee - at_hip, at_ankle - at_knee, at_ankle + offsets[frames] - at_hip
    a, b = np.linalg.norm(thigh, axis=-1), np.linalg.norm(shin, axis=-1)
    reach = np.linalg.norm(at_ankle - at_hip, axis=-1)
    wanted = np.linalg.norm(target, axis=-1)
    wanted = np.minimum(wanted, np.maximum(_STRETCH * (a + b), reach))  # a stretched leg does not stretch further
    forward = (skeleton.rest_joints[foot] - skeleton.rest_joints[ankle]) * [1, 0, 1]
    hinge = np.cross([0, -1, 0], -forward) / max(float(np.linalg.norm(forward)), 1e-12)
    # a straight leg bends about the knee's hinge, a bent one in its plane
    axis = np.cross(thigh, shin) / (a * b)[:, None] + _STRAIGHT * of_knee @ hinge
    axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    angle = np.zeros(len(frames))
    for _ in range(_STEPS):  # Newton's, on the leg's length
        bent = axis_angle_to_matrix(axis * angle[:, None])
        turned = np.einsum("frc,fc->fr", bent, shin)
        now = thigh + turned
        length = np.linalg.norm(now, axis=-1)
        slope = (now * np.cross(axis, turned)).sum(-1) / length
        angle += np.clip((wanted - length) / np.minimum(slope, -_SLOWEST), -0.2, 0.2)
    bent = axis_angle_to_matrix(axis * angle[:, None])
    now = thigh + np.einsum("frc,fc->fr", bent, shin)
    swung = _rotation_between(now, target)
    new_hip, new_knee = swung @ of_hip, swung @ bent @ of_knee
    up = posed[frames, skeleton.parents[hip], :3, :3] if skeleton.parents[hip] >= 0 else np.eye(3)
    rotations[frames, hip] = np.swapaxes(up, -1, -2) @ new_hip
    rotations[frames, knee] = np.swapaxes(new_hip, -1, -2) @ new_knee
    rotations[frames, ankle] = np.swapaxes(new_knee, -1, -2) @ of_ankle


def _rotation_between(source: Floats, target: Floats) -> Floats:
    """Least rotations [F, 3, 3] of directions ``source`` [F, 3] to ``target``."""
    source = source / np.linalg.norm(source, axis=-1, keepdims=True)
    target = target / np.linalg.norm(target, axis=-1, keepdims=True)
    axis = np.cross(source, target)
    sine, cosine = np.linalg.norm(axis, axis=-1), (source * target).sum(-1)
    return axis_angle_to_matrix(axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None])
