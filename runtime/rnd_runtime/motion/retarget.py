"""Retargeting of a motion from its own skeleton to the avatar's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.tree import MocapTree

from .skeleton import Skeleton, moving_joints
from .solving.bones import SPINE, hips, leg_length
from .solving.directions import unit
from .solving.evidence import Tracks
from .solving.palms import palm_axes
from .solving.solve import solve
from .solving.tips import find_tips
from .standing import UP_ROTATIONS, up_axis

Floats = NDArray[np.float64]

_LIMBS = {f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "hip", "knee")}
_LEG = 0.85  # m, against which heights are judged
_STANDS = 0.5  # mean cosine of the trunk and the up axis of a recording, which may crouch and jump
_CLEARLY, _HIPS = 0.7, (0.6, 1.3)  # the same, and heights of hips in legs, that make Z up before Y is doubted
_FARTHEST = 1e9  # from the origin, in any unit
_APART = 1e-3  # of a leg, min distance of the hips and length of the trunk
_FLOOR_PERCENTILE = 5  # of the lowest foot's height over time, against noise
_ABOVE_SOLE = {"_ankle": 0.076, "_foot": 0.028}  # m, mean of bodies within 3 mm
_STANDS_AT_ZERO = 0.05  # m, tolerance for the sole of a template that stands on y = 0
_BACKWARDS = 0.5  # min mean cosine of toes and knees that say that left is right
_T_POSE = np.radians(15)
_T_POSE_LEAP = np.radians(20)


@dataclass(frozen=True, eq=False)
class Retargeted:
    """Motion of the avatar's skeleton, Y up: local ``rotations`` [F, J, 3, 3], ``translations`` [F, 3] m from rest.

    ``left_out``: unused moving joints of the recorded skeleton.
    """

    rotations: Floats
    translations: Floats
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def retarget(tree: MocapTree, skeleton: Skeleton, matched: Mapping[str, int], up: str = "auto") -> Retargeted:
    """Retarget the motion of ``tree`` to ``skeleton``: ``retarget_tracks`` of the joints' positions and rotations.

    Args:
        matched: index in ``tree`` of each of the avatar's joints; the others stay at rest.
        up: the file's up axis, "y" or "z"; "auto" infers it from the trunk.

    Raises:
        InputError: ``matched`` lacks hips or knees, which give the person's size.
    """
    recorded = tree.global_rotations()
    positions = tree.positions(recorded)
    tracks = Tracks(
        {name: positions[:, joint] for name, joint in matched.items()},
        {name: recorded[:, joint] for name, joint in matched.items()},
        palm_axes(tree, positions, matched),
        tree.fps,
        find_tips(tree, positions, recorded, matched),
    )
    moved = retarget_tracks(tracks, skeleton, up, "z" if _stands_along_z(tree, matched) else "y")
    return replace(moved, notes=(*tree.notes, *moved.notes), left_out=_left_out(tree, set(matched.values())))


def retarget_tracks(tracks: Tracks, skeleton: Skeleton, up: str = "auto", usual_up: str = "y") -> Retargeted:
    """Retarget positions, and rotations where there are any, to ``skeleton`` (``.solve``).

    Lengths scale with the legs, and the feet stand on y = 0. The motion is rotated by quarters to begin facing +Z. A
    leading reference T-pose is left out. A mirrored recording, in left-handed axes, is mirrored back.

    Args:
        tracks: in the file's axes.
        up: the file's up axis, "y" or "z"; "auto" infers it from the trunk.
        usual_up: the axis that a person who lies is taken to lie on.

    Raises:
        InputError: ``tracks`` lack hips or knees, or have them in one position.
    """
    _check(tracks.points)
    tracks, notes = _upright(tracks, up, usual_up)
    rotations = _local_rotations(solve(tracks, skeleton), skeleton)
    limbs = [k for k, name in enumerate(skeleton.names) if name in _LIMBS and name in tracks.points]
    if first := _reference_frames(rotations[:, limbs]):
        tracks = tracks.after(first)
        rotations = _local_rotations(solve(tracks, skeleton), skeleton)
    quarters = _quarters_to_front(rotations[0, 0])
    heading = axis_angle_to_matrix([0, quarters * np.pi / 2, 0])
    rotations[:, 0] = heading @ rotations[:, 0]

    rest = dict(zip(skeleton.names, skeleton.rest_joints))
    scale = leg_length({name: rest[name] for name in tracks.points}) / leg_length(tracks.points)
    pelvis = scale * hips(tracks.points) @ heading.T - rotations[:, 0] @ (hips(rest) - skeleton.rest_joints[0])
    translations = pelvis - skeleton.rest_joints[0]
    translations[:, 1] -= _floor(skeleton, rotations, translations)
    if quarters:
        notes.append(f"rotated by {quarters * 90:+d}° about the vertical, to begin facing the front")
    if first:
        notes.append("the first frame, a T-pose for reference, is left out")
    if resting := [name for name in skeleton.names if name not in tracks.points]:
        notes.append(f"joints that the motion lacks stay at rest: {', '.join(resting)}")
    return Retargeted(rotations, translations, tuple(notes), ())


def _check(points: Mapping[str, Floats]) -> None:
    needed = ("left_hip", "right_hip", "left_knee", "right_knee")
    if missing := [name for name in needed if name not in points]:
        raise InputError(
            "joints of the motion",
            expected=", ".join(needed),
            got=f"no {', '.join(missing)}",
            hint="name them in a file given as --joint-map",
        )
    largest = max(float(np.abs(place).max()) for place in points.values())
    if not largest < _FARTHEST:  # nor NaN
        raise InputError("skeleton of the motion", expected=f"finite places, at most {_FARTHEST:g}", got=f"{largest:g}")
    leg = leg_length(points)
    if leg < 1e-9:
        raise InputError("skeleton of the motion", expected="legs", got="hips and knees in one position")
    apart = (points["left_hip"] - points["right_hip"], _trunk(points))
    if min(float(np.median(np.linalg.norm(vector, axis=-1))) for vector in apart) < _APART * leg:
        raise InputError("skeleton of the motion", expected="hips apart and a trunk", got="joints in one position")


def _trunk(points: Mapping[str, Floats]) -> Floats:
    """From the hips to the highest joint of the trunk [F, 3], or from the knees to the hips."""
    high = next((points[name] for name in ("neck", "head", *SPINE[::-1]) if name in points), None)
    return hips(points) - (points["left_knee"] + points["right_knee"]) / 2 if high is None else high - hips(points)


def _stands_along_z(tree: MocapTree, matched: Mapping[str, int]) -> bool:
    """Whether the zero pose's trunk points along +Z."""
    zero = tree.zero_positions()
    points = {name: zero[joint] for name, joint in matched.items()}
    if not {"left_hip", "right_hip", "left_knee", "right_knee"} <= points.keys():
        return False
    return bool(unit(_trunk(points))[2] > 0.8)


def _upright(tracks: Tracks, up: str, usual_up: str) -> tuple[Tracks, list[str]]:
    """``tracks`` with Y up and right-handed, and notes."""
    axis, notes = up, list[str]()
    if up == "auto":
        heights = hips(tracks.points) * _LEG / leg_length(tracks.points)
        trunk = unit(_trunk(tracks.points))
        clear = usual_up == "y" and trunk[:, 2].mean() > _CLEARLY and _at_leg_height(heights[:, 2])
        if clear and not _at_leg_height(heights[:, 1]):
            axis = "z"
            notes.append("z is taken for up, as the trunk stands along it; --motion-up y overrules")
        else:
            axis, found = up_axis(trunk, heights, usual_up, _STANDS)
            notes += [note for note in found if axis != "y" or usual_up == "y"]
    world = UP_ROTATIONS[axis]
    if _is_mirrored(tracks.points):
        world = np.diag([-1.0, 1, 1]) @ world
        notes.append("the skeleton's left is its right, as in left-handed axes: mirrored back")

    def moved(vectors: Floats) -> Floats:
        return vectors @ world.T

    flip = np.diag([np.linalg.det(world), 1.0, 1.0])  # the recorded axes stay right-handed
    return replace(
        tracks,
        points={name: moved(points) for name, points in tracks.points.items()},
        rotations={name: world @ rotations @ flip for name, rotations in tracks.rotations.items()},
        palms={side: (moved(axis), at_rest) for side, (axis, at_rest) in tracks.palms.items()},
        tips={name: moved(tip) for name, tip in tracks.tips.items()},
    ), notes


def _at_leg_height(heights: Floats) -> bool:
    """Whether hips at ``heights`` [F] m may be those of somebody who stands or crouches on a floor at 0."""
    low, middle = np.quantile(heights, [0.05, 0.5]) / _LEG
    return bool(low > 0 and _HIPS[0] < middle < _HIPS[1])


def _is_mirrored(points: Mapping[str, Floats]) -> bool:
    """Whether toes point and knees bend to where the back is, by the hips' left and right."""
    forward = unit(np.cross(points["left_hip"] - points["right_hip"], _trunk(points)))
    seen = []
    for side in ("left", "right"):
        hip, knee, ankle, toe = (points.get(f"{side}_{joint}") for joint in ("hip", "knee", "ankle", "foot"))
        if hip is None or knee is None or ankle is None:
            continue
        if toe is not None and np.median(np.linalg.norm(toe - ankle, axis=-1)) > _APART * leg_length(points):
            seen.append(float((unit(toe - ankle) * forward).sum(-1).mean()))
        bend = unit(knee - hip) - unit(ankle - knee)  # points to where the knee does
        weight = (bend * bend).sum(-1)
        if (weight > 0.1).any():
            seen.append(float((bend * forward).sum(-1)[weight > 0.1].mean() / np.sqrt(weight[weight > 0.1].mean())))
    return len(seen) >= 2 and max(seen) < -_BACKWARDS


def _left_out(tree: MocapTree, matched: set[int]) -> tuple[str, ...]:
    """Moving joints of ``tree`` without any of ``matched`` below them."""
    carry = {0, *matched}
    for joint in reversed(range(len(tree.names))):
        if joint in carry and joint:
            carry.add(tree.parents[joint])
    return tuple(tree.names[k] for k in np.flatnonzero(moving_joints(tree.rotations)) if k not in carry)


def _local_rotations(rotations: Floats, skeleton: Skeleton) -> Floats:
    """World rotations [F, J, 3, 3] in each parent's frame."""
    above = rotations[:, np.maximum(skeleton.parents, 0)].copy()
    above[:, 0] = np.eye(3)
    local: Floats = np.swapaxes(above, -1, -2) @ rotations
    return local


def _quarters_to_front(root: Floats) -> int:
    """Quarter rotations about Y, −1 to 2, that bring a root rotation [3, 3] nearest to facing +Z."""
    x, _, z = root[:, 2]
    quarters = -round(np.arctan2(x, z) / (np.pi / 2)) if np.hypot(x, z) > 0.5 else 0  # 0 for a lying person
    return 2 if quarters == -2 else quarters


def _floor(skeleton: Skeleton, rotations: Floats, translations: Floats) -> float:
    """Height in m of standing feet above the floor, y = 0; 0 without feet."""
    feet = [k for k, name in enumerate(skeleton.names) if name.endswith(tuple(_ABOVE_SOLE))]
    if not feet:
        return 0.0
    height = skeleton.joint_transforms(rotations, translations)[:, feet, 1, 3] - skeleton.rest_joints[feet, 1]
    return float(np.percentile(height.min(1), _FLOOR_PERCENTILE)) + sole(skeleton)


def sole(skeleton: Skeleton) -> float:
    """Height in m of the soles at rest; 0 without feet, or for a template that stands on y = 0."""
    heights = [
        float(joint[1]) - above
        for name, joint in zip(skeleton.names, skeleton.rest_joints)
        for end, above in _ABOVE_SOLE.items()
        if name.endswith(end)
    ]
    height = min(heights, default=0.0)
    return height if abs(height) > _STANDS_AT_ZERO else 0.0


def _reference_frames(rotations: Floats) -> int:
    """1 where limbs' ``rotations`` [F, ·, 3, 3] begin with a separate T-pose, else 0."""
    if len(rotations) < 3:
        return 0
    local = rotations[:2]
    leap = np.swapaxes(local[0], -1, -2) @ local[1]

    def angle(rotation: Floats) -> float:
        cosines = (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2
        return float(np.arccos(np.clip(cosines, -1, 1)).max())

    return int(angle(local[0]) < _T_POSE and angle(leap) > _T_POSE_LEAP)
