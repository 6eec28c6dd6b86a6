"""What a recording shows of the rolls of its bones: hinges of knees and elbows, feet, palms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.skeleton import Skeleton

from .bones import SPINE, find_bones, rest_directions
from .directions import Floats, across, angle_about, swing, unit
from .tips import with_tips

Complexes = NDArray[np.complex128]

_HINGES = {"hip": ("hip", "knee", "ankle"), "shoulder": ("shoulder", "elbow", "wrist")}
_HINGES |= {"knee": _HINGES["hip"], "elbow": _HINGES["shoulder"]}
# Errors of what shows a roll, degrees (rms): a hinge bent by 90°, a foot, a palm, and the parent's roll, which is
# neutral. About what 64 clips of eight mocap sources have, but for the palm's, which is assumed.
_HINGE, _FOOT, _PALM = 3.0, 8.0, 5.0
_NEUTRAL, _NEUTRAL_ELSE = {"knee": 3.0, "elbow": 8.0, "hip": 10.0}, 30.0
_APART = 0.2  # of the hips' distance


@dataclass(frozen=True, eq=False)
class Tracks:
    """A recording under the avatar's joint names, Y up.

    Attributes:
        points: [F, 3] of each recorded joint, in any unit.
        rotations: [F, 3, 3] of joints in the world, relative to any zero pose.
        palms: by side, an axis [F, 3] across the palm and its direction [3] where the arm is held along ±X, palm down.
        fps: frames per second.
        tips: [F, 3] of what lies beyond the last joint of a limb or the head, by that joint.
    """

    points: Mapping[str, Floats]
    rotations: Mapping[str, Floats] = field(default_factory=dict)
    palms: Mapping[str, tuple[Floats, Floats]] = field(default_factory=dict)
    fps: float = 30.0
    tips: Mapping[str, Floats] = field(default_factory=dict)

    def after(self, first: int) -> Tracks:
        """Without the ``first`` frames."""
        return replace(
            self,
            points={name: points[first:] for name, points in self.points.items()},
            rotations={name: rotations[first:] for name, rotations in self.rotations.items()},
            palms={side: (axis[first:], in_t_pose) for side, (axis, in_t_pose) in self.palms.items()},
            tips={name: tip[first:] for name, tip in self.tips.items()},
        )


class Evidence(NamedTuple):
    """An axis across a bone that shows its roll.

    Attributes:
        axis: [F, 3] in the world; zero shows nothing.
        at_rest: the same [3] at rest.
        error: degrees (rms) of an axis of length one; of a shorter one, divided by its length.
    """

    axis: Floats
    at_rest: Floats
    error: float

    @property
    def size(self) -> Floats:
        """Square of the axis' length [F], of a hinge sin² of its bend."""
        size: Floats = (self.axis * self.axis).sum(-1)
        return size

    def mean_size(self) -> float:
        """Over the clip, weighted by itself."""
        return float((self.size**2).sum() / max(self.size.sum(), 1e-12))

    def rolls(self, bone: Floats, base: Floats) -> Complexes:
        """Weighted e^{iφ} [F] of the rolls about ``bone`` [F, 3] from rotations ``base`` to what is seen.

        Weights are inverse variances.
        """
        angles = angle_about(bone, base @ self.at_rest, self.axis)
        weighted: Complexes = self.size / np.radians(self.error) ** 2 * np.exp(1j * angles)
        return weighted

    def over_clip(self, bone: Floats, base: Floats) -> complex:
        """The same of the one roll that holds throughout the clip, whose scatter counts as error too."""
        rolls = self.rolls(bone, base)
        resultant = min(coherence(rolls), 1 - 1e-12)
        if not resultant:
            return 0j
        variance = np.radians(self.error) ** 2 / self.mean_size() - 2 * np.log(
            resultant
        )  # the latter of a wrapped normal
        return complex(np.exp(1j * np.angle(rolls.sum())) / variance)


class Recorded:
    """The points of a recording with its bones and the trunk's axes.

    Attributes:
        tracks: [F] frames, Y up.
        rest: joint positions [3] of the avatar at rest.
        points: [F, 3] of the joints, and of tips that stand in for some (``tips.with_tips``).
        bones: of joints that have a direction.
        at_rest: directions [3] of the avatar's bones that stand for ``bones``.
        chest: the highest joint of the spine, or "".
        pelvis_axis: from the right hip to the left [F, 3], and at rest [3].
        chest_axis: the same of the collars, or the shoulders.
    """

    def __init__(self, tracks: Tracks, skeleton: Skeleton) -> None:
        root = skeleton.names[0]
        self.tracks, self.rest = tracks, dict(zip(skeleton.names, skeleton.rest_joints))
        self.points = with_tips(tracks.points, tracks.tips)
        self.bones = find_bones(self.points, self.rest, root)
        self.at_rest = rest_directions(self.bones, self.points, self.rest, root, tracks.fps)
        spine = [name for name in SPINE if name in self.bones]
        self.chest = spine[-1] if spine else ""
        self.pelvis_axis = self._to_the_left("hip")
        self.chest_axis = self._chest_axis()

    def _to_the_left(self, pair: str) -> tuple[Floats, Floats]:
        right, left = f"right_{pair}", f"left_{pair}"
        return self.tracks.points[left] - self.tracks.points[right], self.rest[left] - self.rest[right]

    def _chest_axis(self) -> tuple[Floats, Floats]:
        wide = np.linalg.norm(self.pelvis_axis[0], axis=-1).mean()
        for pair in ("collar", "shoulder"):
            if {f"left_{pair}", f"right_{pair}"} <= self.tracks.points.keys():
                axis = self._to_the_left(pair)
                if np.linalg.norm(axis[0], axis=-1).mean() > _APART * wide:
                    return axis
        return self.pelvis_axis

    def prior(self, name: str, bone: Floats, neutral: Floats) -> list[Evidence]:
        """The roll where nothing else shows it: between pelvis and chest, or the parent's and towards the toes."""
        part, lateral = name.rpartition("_")[2], lateral_at_rest(name, self.at_rest[name])
        error = _NEUTRAL.get(part, _NEUTRAL_ELSE)
        if name in SPINE:
            spine = [joint for joint in SPINE if joint in self.bones]
            share = (spine.index(name) + 1) / len(spine)
            left = (1 - share) * unit(self.pelvis_axis[0]) + share * unit(self.chest_axis[0])
            return [Evidence(left, lateral, error)]
        foot = self.foot_axis(name) if part in ("hip", "knee") else None
        return [Evidence(neutral @ lateral, lateral, error), *([foot] if foot else [])]

    def foot_axis(self, name: str) -> Evidence | None:
        """The axis across shin and foot, for the joints of a leg."""
        side, _, part = name.partition("_")
        joints = [f"{side}_{joint}" for joint in ("knee", "ankle", "foot")]
        if part not in ("hip", "knee", "ankle") or joints[1] not in self.bones or joints[0] not in self.bones:
            return None
        shin, foot = (unit(self.bones[joint].along(self.points)) for joint in joints[:2])
        at_rest = np.cross(-self.at_rest[joints[0]], self.at_rest[joints[1]])
        return Evidence(np.cross(-shin, foot), at_rest, _FOOT)

    def shown(self, name: str) -> Evidence:
        """What the recording shows of the roll about the bone of joint ``name``; a zero axis for nothing."""
        points, (side, _, part) = self.points, name.partition("_")
        if part == "ankle" and (foot := self.foot_axis(name)) is not None:
            return foot
        if part == "wrist" and side in self.tracks.palms:
            axis, in_t_pose = self.tracks.palms[side]
            return Evidence(axis, swing(outwards(side), self.at_rest[name]) @ in_t_pose, _PALM)
        joints = [f"{side}_{joint}" for joint in _HINGES.get(part, ())]
        axis = np.zeros_like(points["left_hip"])
        if joints and points.keys() >= set(joints):
            upper, lower = (unit(points[b] - points[a]) for a, b in pairwise(joints))
            axis = np.cross(upper, lower)
        return Evidence(axis, lateral_at_rest(name, self.at_rest[name]), _HINGE)


def lateral_at_rest(name: str, direction: Floats) -> Floats:
    """The axis about which the limb of joint ``name`` bends, where its bone points along ``direction`` at rest."""
    side, _, part = name.partition("_")
    sideways = outwards(side)
    if part in ("shoulder", "elbow"):
        return np.asarray(swing(sideways, direction) @ np.array([0.0, -sideways[0], 0.0]))
    if side in ("left", "right") and part not in ("hip", "knee", "ankle", "foot"):
        return np.asarray(swing(sideways, direction) @ np.array([0.0, 0.0, 1.0]))
    return across(np.array([1.0, 0, 0]), direction)


def outwards(side: str) -> Floats:
    """±X, where the arm of ``side`` points in a T-pose."""
    return np.array([1.0 if side == "left" else -1.0, 0, 0])


def coherence(rolls: Complexes) -> float:
    """Mean resultant length, 0 to 1; 0 without weights."""
    total = float(np.abs(rolls).sum())
    return float(abs(rolls.sum())) / total if total > 1e-9 else 0.0


def smooth(values: Complexes, sigma: float) -> Complexes:
    """``values`` [F] through a Gaussian of ``sigma`` frames; the first and last go on beyond the ends."""
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    filtered: Complexes = np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid")
    return filtered
