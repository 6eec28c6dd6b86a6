"""Bones of a recording, and the directions of the avatar's bones at rest that stand for theirs.

Programs put the joints of a spine, a collar or a foot at different places of the same body. Where a recording shows
the body in a posture that is known (upright, the sole on the floor, the arms hanging), the difference is measured
there and taken off.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .directions import Floats, about, angle_about, body_frame, median_rotation, swing, unit, weighted_median

SPINE = ("spine1", "spine2", "spine3")
_TOWARDS = {
    "spine1": ("spine2", "spine3", "neck"),
    "spine2": ("spine3", "neck"),
    "spine3": ("neck",),
    "neck": ("head",),
    "*_collar": ("*_shoulder",),
    "*_shoulder": ("*_elbow",),
    "*_elbow": ("*_wrist",),
    "*_wrist": ("*_hand", "*_middle1", "*_index1"),
    "*_hip": ("*_knee",),
    "*_knee": ("*_ankle",),
    "*_ankle": ("*_foot",),
}
_SHORTEST = 0.03  # of a leg: shorter bones have no direction
_X = np.array([1.0, 0, 0])

_SAME_SPINE_LENGTH, _SAME_LEG_LENGTH = 0.15, 0.02  # of the avatar's: then the joints are at the same places
_UPRIGHT = np.cos(np.radians([30.0, 15.0]))  # angle of trunk and thighs: no weight, full weight
_SAME_SPINE, _SAME_COLLAR, _SAME_FOOT = np.radians(8), np.radians(10), np.radians(4)  # differences that are posture
_COLLAR_BASE = 0.12  # of the shoulders' width: difference of the collars' distance
_STANDS = 0.25  # legs per second: speed of a foot that stands
_LOW = 0.06  # legs above its lowest position
_LEVEL = np.cos(np.radians(50))  # max pitch of a foot that stands


class Bone(NamedTuple):
    """Joints between which a bone points; "hips" is the middle of both."""

    start: str
    end: str

    def along(self, joints: Mapping[str, Floats]) -> Floats:
        """[..., 3]"""
        start = hips(joints) if self.start == "hips" else joints[self.start]
        return joints[self.end] - start


def hips(joints: Mapping[str, Floats]) -> Floats:
    """The middle of the hips [..., 3]."""
    return (joints["left_hip"] + joints["right_hip"]) / 2


def leg_length(joints: Mapping[str, Floats]) -> float:
    """Mean length from hip to knee, and to the ankle where known; 0 where hip and knee are in one position."""
    lengths = []
    for side in ("left", "right"):
        chain = [joints[f"{side}_{joint}"] for joint in ("hip", "knee", "ankle") if f"{side}_{joint}" in joints]
        lengths.append(sum(float(np.median(np.linalg.norm(b - a, axis=-1))) for a, b in pairwise(chain)))
    return sum(lengths) / 2 if min(lengths) > 0 else 0.0


def find_bones(points: Mapping[str, Floats], rest: Mapping[str, Floats], root: str) -> dict[str, Bone]:
    """The bone of each joint of ``points`` [F, 3] that has a direction there and at ``rest`` [3]."""
    leg, leg_rest = leg_length(points), leg_length(rest)

    def long(bone: Bone) -> bool:
        if bone.end not in points or bone.end not in rest:
            return False
        lengths = np.linalg.norm(bone.along(points), axis=-1)
        return bool(np.median(lengths) > _SHORTEST * leg and np.linalg.norm(bone.along(rest)) > _SHORTEST * leg_rest)

    spine = [joint for joint in SPINE if joint in points and joint in rest]
    bones: dict[str, Bone] = {}
    for name in points:
        if name == root:
            continue
        side, _, part = name.partition("_")
        ends = _TOWARDS.get(name) or tuple(end.replace("*", side) for end in _TOWARDS.get(f"*_{part}", ()))
        starts = (name, *spine[:-1][::-1]) if spine and name == spine[-1] else (name,)
        if found := [bone for start in starts for end in ends if long(bone := Bone(start, end))]:
            bones[name] = found[0]
    trunk = [bone for end in (*spine, "neck", "head") if long(bone := Bone("hips", end))]
    if trunk:
        bones[root] = trunk[0]
    return bones


def rest_directions(
    bones: Mapping[str, Bone], points: Mapping[str, Floats], rest: Mapping[str, Floats], root: str, fps: float
) -> dict[str, Floats]:
    """Direction [3] at rest of each of ``bones``, corrected where the recorded skeleton's joints are elsewhere."""
    directions = {name: unit(bone.along(rest)) for name, bone in bones.items()}
    trunk = next((end for end in ("neck", "head", *SPINE[::-1]) if end in points and end in rest), "")
    if trunk:
        neutral, weights = _trunk_line(Bone("hips", trunk), points, rest)
        same = _same_lengths((root, *SPINE), _SAME_SPINE_LENGTH, bones, points, rest)
        for name in () if same else (root, *SPINE, "neck"):
            if name not in bones:
                continue
            tilts = angle_about(neutral @ _X, neutral @ directions[name], bones[name].along(points))
            tilt = weighted_median(tilts, weights)
            if abs(tilt) > _SAME_SPINE:
                directions[name] = about(_X, np.array(tilt)) @ directions[name]
        _correct_collars(directions, bones, points, rest, neutral)
    for side in ("left", "right"):
        leg = tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle"))
        if leg[-1] in bones and not _same_lengths(leg, _SAME_LEG_LENGTH, bones, points, rest):
            _correct_foot(directions, leg[-1], bones, points, fps)
    return directions


def _same_lengths(
    names: Iterable[str],
    tolerance: float,
    bones: Mapping[str, Bone],
    points: Mapping[str, Floats],
    rest: Mapping[str, Floats],
) -> bool:
    """Whether the bones of ``names`` are as long as at ``rest``, so that their joints are at the same places."""
    leg, leg_rest = leg_length(points), leg_length(rest)
    for name in names:
        if name in bones:
            length = float(np.median(np.linalg.norm(bones[name].along(points), axis=-1))) / leg
            if abs(length / (float(np.linalg.norm(bones[name].along(rest))) / leg_rest) - 1) > tolerance:
                return False
    return True


def _trunk_line(line: Bone, points: Mapping[str, Floats], rest: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Rotations [F, 3, 3] of a trunk that is straight between its ends, and how far thighs are in line with it [F]."""
    along, left = line.along(points), points["left_hip"] - points["right_hip"]
    if {"left_shoulder", "right_shoulder"} <= points.keys():
        left = unit(left) + unit(points["left_shoulder"] - points["right_shoulder"])
    at_rest = body_frame(rest["left_hip"] - rest["right_hip"], line.along(rest))
    neutral = body_frame(left, along) @ at_rest.T
    down = [unit(points[f"{side}_knee"] - points[f"{side}_hip"]) for side in ("left", "right")]
    in_line = -(unit(along) * unit(down[0] + down[1])).sum(-1)
    low, high = _UPRIGHT
    return neutral, np.clip((in_line - low) / (high - low), 0, 1)


def _correct_collars(
    directions: dict[str, Floats],
    bones: Mapping[str, Bone],
    points: Mapping[str, Floats],
    rest: Mapping[str, Floats],
    neutral: Floats,
) -> None:
    """Collars that start elsewhere, as at the neck, point to the shoulders from there."""
    if not {"left_collar", "right_collar"} <= bones.keys():
        return
    base, base_rest = (
        np.median(
            np.linalg.norm(joints["left_collar"] - joints["right_collar"], axis=-1)
            / np.linalg.norm(joints["left_shoulder"] - joints["right_shoulder"], axis=-1)
        )
        for joints in (points, rest)
    )
    if abs(base - base_rest) < _COLLAR_BASE:
        return
    for side in ("left", "right"):
        name = f"{side}_collar"
        local = np.swapaxes(neutral, -1, -2) @ unit(bones[name].along(points))[..., None]
        usual = median_rotation(swing(directions[name], local[..., 0]))
        if np.arccos(np.clip((np.trace(usual) - 1) / 2, -1, 1)) > _SAME_COLLAR:
            directions[name] = usual @ directions[name]


def _correct_foot(
    directions: dict[str, Floats], name: str, bones: Mapping[str, Bone], points: Mapping[str, Floats], fps: float
) -> None:
    """A foot that stands has its sole on the floor, whatever its ankle's height."""
    ankle, toe, leg = points[name], points[bones[name].end], leg_length(points)
    speed = np.linalg.norm(np.gradient(ankle, axis=0), axis=-1) * fps if len(ankle) > 1 else np.zeros(1)
    low = np.maximum(ankle[:, 1] - np.percentile(ankle[:, 1], 2), toe[:, 1] - np.percentile(toe[:, 1], 2))
    along = unit(toe - ankle)
    level = np.hypot(along[:, 0], along[:, 2])
    stands = (speed < _STANDS * leg) & (low < _LOW * leg) & (level > _LEVEL)
    pitch = np.arctan2(along[:, 1], level)
    at_rest = directions[name]
    tilt = weighted_median(pitch, stands.astype(float)) - float(
        np.arctan2(at_rest[1], np.hypot(at_rest[0], at_rest[2]))
    )
    if stands.any() and abs(tilt) > _SAME_FOOT:
        lateral = unit(np.cross(at_rest, [0.0, 1, 0]))
        directions[name] = about(lateral, np.array(tilt)) @ at_rest
