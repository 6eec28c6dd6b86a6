"""Skeletons that files know by joint order alone: SOMA's 77 and 30 joints, MHR's 127; and trees from world poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rnd_runtime.motion.readers.tree import Floats, MocapTree

_SIDES = ("Left", "Right")


@dataclass(frozen=True)
class Rig:
    """A skeleton known by its order.

    Attributes:
        names: J joint names.
        parents: [J], −1 for the root; parents come first.
        ours: SMPL's name of the joints that it has.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    ours: Mapping[str, str]

    def matched(self, names: Sequence[str]) -> dict[str, int]:
        """Index in the tree's ``names`` by SMPL's name."""
        return {ours: names.index(theirs) for theirs, ours in self.ours.items() if theirs in names}


def _chain(names: str, above: str, parents: dict[str, str]) -> None:
    """Hang ``names``, one below the other, under ``above``."""
    for name in names.split():
        parents[name] = above
        above = name


def _rig(parents: Mapping[str, str], ours: Mapping[str, str]) -> Rig:
    names = tuple(parents)
    return Rig(names, tuple(names.index(above) if above else -1 for above in parents.values()), ours)


def _soma77() -> Rig:
    parents: dict[str, str] = {}
    _chain("Hips Spine1 Spine2 Chest Neck1 Neck2 Head HeadEnd", "", parents)
    parents |= dict.fromkeys(("Jaw", "LeftEye", "RightEye"), "Head")
    for side in _SIDES:
        _chain(" ".join(f"{side}{part}" for part in ("Shoulder", "Arm", "ForeArm", "Hand")), "Chest", parents)
        for finger, count in (("Thumb", 3), ("Index", 4), ("Middle", 4), ("Ring", 4), ("Pinky", 4)):
            joints = [f"{side}Hand{finger}{k}" for k in (*range(1, count + 1), "End")]
            _chain(" ".join(joints), f"{side}Hand", parents)
    for side in _SIDES:
        _chain(" ".join(f"{side}{part}" for part in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd")), "Hips", parents)
    ours = {
        "Hips": "pelvis",
        "Spine1": "spine1",
        "Spine2": "spine2",
        "Chest": "spine3",
        "Neck1": "neck",
        "Head": "head",
    }
    parts = {
        **{"Shoulder": "collar", "Arm": "shoulder", "ForeArm": "elbow", "Hand": "wrist", "HandMiddle2": "hand"},
        **{"Leg": "hip", "Shin": "knee", "Foot": "ankle", "ToeBase": "foot"},
    }
    ours |= {f"{side}{theirs}": f"{side.lower()}_{part}" for side in _SIDES for theirs, part in parts.items()}
    return _rig(parents, ours)


def _soma30() -> Rig:
    """Of the 77 those that Kimodo's smaller skeleton keeps, each below the next that is kept."""
    ends = {f"{side}Hand{finger}End" for side in _SIDES for finger in ("Thumb", "Middle")}
    gone = {"HeadEnd", "LeftToeEnd", "RightToeEnd"}
    kept = dict(zip(SOMA77.names, SOMA77.parents))
    parents: dict[str, str] = {}
    for name in SOMA77.names:
        finger = any(f"{side}Hand" in name and name != f"{side}Hand" for side in _SIDES)
        if name in gone or (finger and name not in ends):
            continue
        above = kept[name]
        while above >= 0 and SOMA77.names[above] not in parents:
            above = SOMA77.parents[above]
        parents[name] = SOMA77.names[above] if above >= 0 else ""
    return _rig(parents, SOMA77.ours)


def _mhr127() -> Rig:
    parents: dict[str, str] = {"body_world": ""}
    _chain("root", "body_world", parents)
    for side in "lr":
        foot = "foot talocrural subtalar transversetarsal ball"
        _chain(" ".join(f"{side}_{part}" for part in ("upleg", "lowleg", *foot.split())), "root", parents)
        _twists(f"{side}_lowleg", range(1, 5), parents)
        _twists(f"{side}_upleg", range(5), parents)
    _chain("c_spine0 c_spine1 c_spine2 c_spine3", "root", parents)
    for side in "rl":
        arm = ("clavicle", "uparm", "lowarm", "wrist_twist", "wrist")
        _chain(" ".join(f"{side}_{part}" for part in arm), "c_spine3", parents)
        for finger, first in (("pinky", 0), ("ring", 1), ("middle", 1), ("index", 1), ("thumb", 0)):
            joints = [f"{side}_{finger}{k}" for k in range(first, 4)] + [f"{side}_{finger}_null"]
            _chain(" ".join(joints), f"{side}_wrist", parents)
        _twists(f"{side}_lowarm", range(1, 5), parents)
        _twists(f"{side}_uparm", range(5), parents)
    parents |= {"c_neck": "c_spine3", "c_neck_twist1_proc": "c_neck", "c_neck_twist0_proc": "c_neck"}
    parents |= {"c_head": "c_neck", "c_jaw": "c_head", "c_teeth": "c_jaw", "c_jaw_null": "c_jaw"}
    _chain("c_tongue0 c_tongue1 c_tongue2 c_tongue3 c_tongue4", "c_jaw", parents)
    for side in "rl":
        _chain(f"{side}_eye {side}_eye_null", "c_head", parents)
    parents["c_head_null"] = "c_head"
    ours = {"root": "pelvis", "c_neck": "neck", "c_head": "head"} | {f"c_spine{k}": f"spine{k}" for k in (1, 2, 3)}
    parts = {
        **{"clavicle": "collar", "uparm": "shoulder", "lowarm": "elbow", "wrist": "wrist", "middle1": "hand"},
        **{"upleg": "hip", "lowleg": "knee", "foot": "ankle", "ball": "foot"},
    }
    ours |= {f"{side[0].lower()}_{theirs}": f"{side.lower()}_{p}" for side in _SIDES for theirs, p in parts.items()}
    return _rig(parents, ours)


def _twists(joint: str, numbers: range, parents: dict[str, str]) -> None:
    parents |= {f"{joint}_twist{k}_proc": joint for k in numbers}


SOMA77 = _soma77()
"""NVIDIA's SOMA (Kimodo, GEM-X, BONES-SEED): ``LeftLeg`` is the thigh, ``LeftShin`` the shin"""
SOMA30 = _soma30()
MHR127 = _mhr127()
"""Meta's Momentum Human Rig (SAM 3D Body)"""


@dataclass(frozen=True, eq=False)
class WorldTree(MocapTree):
    """A recorded skeleton whose joints are where the file has them, whether or not its bones keep their length.

    Attributes:
        world: [F, J, 3] positions in the file's world.
    """

    world: Floats = field(kw_only=True)

    def positions(self, global_rotations: Floats) -> Floats:
        """``world``."""
        return self.world


def world_tree(
    names: Sequence[str],
    parents: Sequence[int],
    positions: Floats,
    rotations: Floats,
    fps: float,
    notes: tuple[str, ...] = (),
) -> WorldTree:
    """A tree from world ``positions`` [F, J, 3] and ``rotations`` [F, J, 3, 3]; offsets are medians."""
    offsets = bone_offsets(parents, positions, rotations)
    local = rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(rotations[:, parent], -1, -2) @ rotations[:, joint]
    root, lengths = positions[:, 0], np.median(offsets, 0)
    return WorldTree(tuple(names), tuple(parents), lengths, local, root, fps, notes, world=positions)


def bone_offsets(parents: Sequence[int], positions: Floats, rotations: Floats) -> Floats:
    """Offset [F, J, 3] of each joint from its parent, in the parent's axes; zero for the root."""
    offsets = np.zeros(positions.shape)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            step = positions[:, joint] - positions[:, parent]
            offsets[:, joint] = np.einsum("fji,fj->fi", rotations[:, parent], step)
    return offsets


def rigidity(parents: Sequence[int], positions: Floats, rotations: Floats) -> float:
    """How far ``rotations`` leave bones where ``positions`` have them: mean deviation over mean length."""
    offsets = bone_offsets(parents, positions, rotations)
    deviation = np.linalg.norm(offsets - np.median(offsets, 0), axis=-1).mean()
    return float(deviation / max(np.linalg.norm(offsets, axis=-1).mean(), 1e-9))
