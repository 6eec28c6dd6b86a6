"""Retargeting of a motion from its own skeleton to the avatar's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.tree import MocapTree

from .skeleton import Skeleton, moving_joints

Floats = NDArray[np.float64]

# Joints whose bones keep their direction. Not the back, whose joints differ between skeletons; hands and feet follow
# their parents.
_LIMBS = {f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "hip", "knee")}
_STANDS = np.cos(np.radians(30))  # max lean of a standing zero pose
_LIES, _STANDS_HIGH = (0.02, 0.65), (0.75, 1.3)  # height of hips above the floor, leg lengths
_UP_CLEAR = 0.3  # min mean cosine of the trunk and the zero pose's up
_FLOOR_PERCENTILE = 5  # of the lowest foot's height over time, against noise
_ABOVE_SOLE = {"_ankle": 0.076, "_foot": 0.028}  # m, mean of bodies within 3 mm
_STANDS_AT_ZERO = 0.05  # m, tolerance for the sole of a template that stands on y = 0
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
    """Retarget the motion of ``tree`` to ``skeleton``.

    A joint's world rotation is ``G_k = W Q_k Bᵀ A_k``: Q_k the recorded one, B and W the rotations from the zero pose's
    and the world's axes to the avatar's, A_k the smallest rotation from the avatar's bone direction to the file's.
    Lengths scale with the legs, and the feet stand on y = 0. The motion is rotated by quarters to begin facing +Z. A
    leading reference T-pose is left out.

    Args:
        matched: index in ``tree`` of each of the avatar's joints; the others stay at rest.
        up: the file's up axis, "y" or "z"; "auto" infers it from the trunk.

    Raises:
        InputError: ``matched`` lacks hips or knees, which give the person's size.
    """
    needed = ("left_hip", "right_hip", "left_knee", "right_knee")
    if missing := [name for name in needed if name not in matched]:
        raise InputError(
            "joints of the motion",
            expected=", ".join(needed),
            got=f"no {', '.join(missing)}",
            hint="name them in a file given as --joint-map",
        )
    source_rest = tree.zero_positions()
    theirs = {name: source_rest[index] for name, index in matched.items()}
    ours = {name: skeleton.rest_joints[k] for k, name in enumerate(skeleton.names) if name in matched}
    to_ours = _body_frame(ours) @ _body_frame(theirs).T
    recorded = tree.global_rotations()
    root = matched.get(skeleton.names[0], 0)
    path = tree.path(root, recorded)
    world, up_notes = _upright(recorded[:, root], path / _leg(theirs), to_ours, up)
    rotations_world = _world_rotations(tree, recorded, world, to_ours, skeleton, matched)
    rotations = _local_rotations(rotations_world, skeleton)
    limbs = [k for k, name in enumerate(skeleton.names) if name in _LIMBS and name in matched]
    first = _reference_frames(rotations[:, limbs])
    quarters = _quarters_to_front(rotations_world[first, 0])
    heading = axis_angle_to_matrix([0, quarters * np.pi / 2, 0])
    rotations, world = rotations[first:], heading @ world
    rotations[:, 0] = heading @ rotations[:, 0]

    scale = _leg(ours) / _leg(theirs)
    hips_theirs = (theirs["left_hip"] + theirs["right_hip"]) / 2
    hips_ours = (ours["left_hip"] + ours["right_hip"]) / 2 - skeleton.rest_joints[0]
    hips = (path + recorded[:, root] @ (hips_theirs - source_rest[root]))[first:]
    pelvis = scale * hips @ world.T - rotations[:, 0] @ hips_ours
    translations = pelvis - skeleton.rest_joints[0]
    translations[:, 1] -= _floor(skeleton, rotations, translations)
    notes = [*tree.notes, *up_notes]
    if quarters:
        notes.append(f"rotated by {quarters * 90:+d}° about the vertical, to begin facing the front")
    if first:
        notes.append("the first frame, a T-pose for reference, is left out")
    resting = [name for name in skeleton.names if name not in matched]
    if resting:
        notes.append(f"joints that the motion lacks stay at rest: {', '.join(resting)}")
    return Retargeted(rotations, translations, tuple(notes), _left_out(tree, set(matched.values())))


def _left_out(tree: MocapTree, matched: set[int]) -> tuple[str, ...]:
    """Moving joints of ``tree`` without any of ``matched`` below them."""
    carry = {0, *matched}
    for joint in reversed(range(len(tree.names))):
        if joint in carry and joint:
            carry.add(tree.parents[joint])
    return tuple(tree.names[k] for k in np.flatnonzero(moving_joints(tree.rotations)) if k not in carry)


def _world_rotations(
    tree: MocapTree, recorded: Floats, world: Floats, to_ours: Floats, skeleton: Skeleton, matched: Mapping[str, int]
) -> Floats:
    """World rotations G [F, J, 3, 3] of the avatar's joints from ``recorded`` [F, ·, 3, 3]."""
    aligned = _alignments(skeleton, matched, tree, to_ours)
    rotations: Floats = np.empty((len(recorded), len(skeleton), 3, 3))
    for joint, name in enumerate(skeleton.names):
        if joint == 0 or name in matched:
            rotations[:, joint] = world @ recorded[:, matched.get(name, 0)] @ to_ours.T @ aligned[joint]
        else:
            rotations[:, joint] = rotations[:, skeleton.parents[joint]]
    return rotations


def _local_rotations(rotations: Floats, skeleton: Skeleton) -> Floats:
    """World rotations [F, J, 3, 3] in each parent's frame."""
    above = rotations[:, np.maximum(skeleton.parents, 0)].copy()
    above[:, 0] = np.eye(3)
    local: Floats = np.swapaxes(above, -1, -2) @ rotations
    return local


def _body_frame(joints: Mapping[str, Floats]) -> Floats:
    """[3, 3] whose columns are left (from the hips), up (the axis nearest to the trunk) and forward of the body."""
    left = joints["left_hip"] - joints["right_hip"]
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    high = [joints[name] for name in ("head", "neck", "spine3", "spine2", "spine1") if name in joints]
    knees = (joints["left_knee"] + joints["right_knee"]) / 2
    up = high[0] - hips if high else hips - knees
    axis = np.eye(3)[np.abs(up).argmax()] * np.sign(up[np.abs(up).argmax()])
    if axis @ up > _STANDS * np.linalg.norm(up):
        up = axis
    forward = np.cross(left, up)
    axes = np.stack([np.cross(up, forward), up, forward], -1)
    lengths = np.linalg.norm(axes, axis=0)
    if lengths.min() < 1e-9:
        raise InputError("skeleton of the motion", expected="hips apart and a trunk", got="joints in one position")
    frame: Floats = axes / lengths
    return frame


def _upright(root: Floats, path: Floats, to_ours: Floats, up: str) -> tuple[Floats, tuple[str, ...]]:
    """Rotation [3, 3] from the file's up axis to Y, and a note where the trunk stands along another axis.

    ``path`` [F, 3] is the root's in leg lengths: a person lies or crawls with hips half a leg above the floor.
    """
    trunk = to_ours.T[:, 1]  # up in the zero pose
    stands = (root @ trunk).mean(0)
    axis = trunk
    notes: tuple[str, ...] = ()
    if up != "auto":
        axis = np.eye(3)["xyz".index(up)]
    elif stands @ trunk <= _UP_CLEAR:
        along = np.eye(3)[np.abs(stands).argmax()] * np.sign(stands[np.abs(stands).argmax()])
        low, high = (float(np.median(path @ direction)) for direction in (trunk, along))
        ours, other = _axis_name(trunk), _axis_name(along)
        if _LIES[0] < low < _LIES[1] and not _STANDS_HIGH[0] < high < _STANDS_HIGH[1]:
            notes = (f"the trunk lies along {other}, and {ours} stays up, as in the zero pose{_overrules(other)}",)
        else:
            axis = along
            notes = (f"{other} is taken for up, as the trunk stands along it{_overrules(ours)}",)
    return _swing(axis, np.array([0.0, 1.0, 0.0])), notes


def _axis_name(axis: Floats) -> str:
    """The coordinate axis nearest to ``axis``: "y", "-z"."""
    largest = int(np.abs(axis).argmax())
    return ("-" if axis[largest] < 0 else "") + "xyz"[largest]


def _overrules(axis: str) -> str:
    return f"; --motion-up {axis} overrules" if axis in ("y", "z") else ""


def _quarters_to_front(root: Floats) -> int:
    """Quarter rotations about Y, −1 to 2, that bring a root rotation [3, 3] nearest to facing +Z."""
    x, _, z = root[:, 2]
    quarters = -round(np.arctan2(x, z) / (np.pi / 2)) if np.hypot(x, z) > 0.5 else 0  # 0 for a lying person
    return 2 if quarters == -2 else quarters


def _alignments(skeleton: Skeleton, matched: Mapping[str, int], tree: MocapTree, to_ours: Floats) -> dict[int, Floats]:
    """Rotation [3, 3] of each joint from the avatar's rest pose to the file's zero pose, in the avatar's axes."""
    rest = tree.zero_positions()
    aligned: dict[int, Floats] = {}
    for joint, name in enumerate(skeleton.names):
        parent = int(skeleton.parents[joint])
        inherited = aligned[parent] if joint else np.eye(3)
        aligned[joint] = inherited
        children = [
            child for child, above in enumerate(skeleton.parents) if above == joint and skeleton.names[child] in matched
        ]
        if name not in _LIMBS or name not in matched or not children:
            continue
        ours = inherited @ (skeleton.rest_joints[children[0]] - skeleton.rest_joints[joint])
        theirs = to_ours @ (rest[matched[skeleton.names[children[0]]]] - rest[matched[name]])
        if min(np.linalg.norm(ours), np.linalg.norm(theirs)) > 1e-9:
            aligned[joint] = _swing(ours, theirs) @ inherited
    return aligned


def _swing(a: Floats, b: Floats) -> Floats:
    """The smallest rotation from direction ``a`` to direction ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return axis_angle_to_matrix(np.pi * axis / np.linalg.norm(axis))
    return axis_angle_to_matrix(axis / sine * np.arctan2(sine, cosine))


def _leg(joints: Mapping[str, Floats]) -> float:
    """Mean length from hip to knee, and to the ankle where known."""
    lengths = []
    for side in ("left", "right"):
        chain = [joints[f"{side}_{joint}"] for joint in ("hip", "knee", "ankle") if f"{side}_{joint}" in joints]
        lengths.append(sum(float(np.linalg.norm(b - a)) for a, b in pairwise(chain)))
    if min(lengths) < 1e-9:
        raise InputError("skeleton of the motion", expected="legs", got="hips and knees in one position")
    return sum(lengths) / 2


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
