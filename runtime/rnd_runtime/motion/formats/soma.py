"""Motions on NVIDIA's SOMA skeleton as arrays: Kimodo's and SOMA-X' .npz, GEM-X' hpe_results.pt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.arrays import check_rotations, frame_rate
from rnd_runtime.motion.readers.tree import Floats, MocapTree

from .rigs import SOMA30, SOMA77, Rig, world_tree
from .vectors import one_of

_FPS = 30.0
_NOTE = f"no frame rate in the file: {_FPS:g} frames per second assumed, as SOMA's programs have"
_AVERAGE = "bone lengths are not in the file: those of SOMA's neutral body are taken"
_UNITS = {"meters": 1.0, "metres": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_FINGER_STEP = 0.025  # m
# m, T-pose of the neutral body of SOMA-X (Apache-2.0), left side; other joints of fingers follow along the arm
_T_POSE = {
    **{"Hips": (0, 1.010, 0), "Spine1": (0, 1.061, -0.001), "Spine2": (0, 1.133, -0.002), "Chest": (0, 1.206, -0.008)},
    **{
        "Neck1": (0, 1.469, -0.009),
        "Neck2": (0, 1.544, 0.014),
        "Head": (0, 1.608, 0.034),
        "HeadEnd": (0, 1.769, 0.013),
    },
    **{"Jaw": (0, 1.613, 0.064), "LeftEye": (0.031, 1.662, 0.109), "LeftShoulder": (0.016, 1.440, 0.041)},
    **{"LeftArm": (0.164, 1.440, -0.013), "LeftForeArm": (0.453, 1.440, -0.013), "LeftHand": (0.723, 1.440, -0.013)},
    **{"LeftHandThumb1": (0.744, 1.426, 0.018), "LeftHandIndex1": (0.755, 1.435, 0.009)},
    **{"LeftHandMiddle1": (0.754, 1.442, -0.003), "LeftHandRing1": (0.752, 1.440, -0.017)},
    **{"LeftHandPinky1": (0.752, 1.437, -0.030), "LeftLeg": (0.100, 0.927, 0.023), "LeftShin": (0.100, 0.494, 0.023)},
    **{"LeftFoot": (0.100, 0.070, 0.023), "LeftToeBase": (0.100, 0.020, 0.155), "LeftToeEnd": (0.100, 0.002, 0.221)},
}


def is_kimodo(members: Members) -> bool:
    """Whether ``members`` are Kimodo's."""
    return "local_rot_mats" in members.names


def is_somax(members: Members) -> bool:
    """Whether ``members`` are SOMA-X': poses of 77 or 78 joints."""
    return "identity_model_type" in members.names and {"poses", "transl"} <= set(members.names)


def is_gemx(content: Mapping[Any, Any]) -> bool:
    """Whether ``content`` is GEM-X'."""
    return isinstance(content.get("body_params_global"), Mapping)


def kimodo(members: Members) -> tuple[MocapTree, Rig]:
    """``local_rot_mats`` [F, 77 | 30, 3, 3] relative to the T-pose, ``root_positions`` [F, 3]; Y up.

    ``posed_joints`` [F, J, 3] give the bones; without them they are those of SOMA's neutral body. Of several motions
    [N, F, …] the first is taken.
    """
    rotations, motions = members.numbers("local_rot_mats"), 1
    if rotations.ndim == 5 and len(rotations):
        rotations, motions = rotations[0], len(rotations)
    check_rotations(rotations, "local_rot_mats", members.path)
    rig = {77: SOMA77, 30: SOMA30}.get(rotations.shape[1])
    if rig is None:
        robot = " (34 are a Unitree G1's, a robot)" if rotations.shape[1] == 34 else ""
        expected = f"77 or 30 of SOMA{robot}"
        raise InputError("joints of local_rot_mats", expected=expected, got=rotations.shape[1], file=members.path)
    path = members.numbers("root_positions").reshape(motions, -1, 3)[0]
    joints = None
    if "posed_joints" in members.names:
        joints = members.numbers("posed_joints").reshape(motions, -1, len(rig.names), 3)[0]
    tree = _tree(rig, rotations, path, members, joints)
    return replace(tree, notes=(*one_of(motions), *tree.notes)), rig


def somax(members: Members) -> tuple[MocapTree, Rig]:
    """``poses`` [F, 77 or 78, 3 | 3, 3] relative to the T-pose, ``transl`` [F, 3] in ``unit``.

    Of 78 joints the first is a virtual root.
    """
    poses = members.numbers("poses")
    rotations = check_rotations(axis_angle_to_matrix(poses) if poses.ndim == 3 else poses, "poses", members.path)
    if rotations.shape[1] == 78:
        rotations = rotations[:, 1:]
    if rotations.shape[1] != 77:
        raise InputError("joints of the poses", expected="77 of SOMA", got=rotations.shape[1], file=members.path)
    if "joint_orient" not in members.names:
        expected = "poses relative to SOMA's T-pose, with joint_orient"
        raise InputError("poses", expected=expected, got="absolute ones", file=members.path)
    unit = members.strings("unit")[0] if "unit" in members.names else "meters"
    if unit not in _UNITS:
        raise InputError("unit", expected=" or ".join(_UNITS), got=unit, file=members.path)
    return _tree(SOMA77, rotations, _UNITS[unit] * members.numbers("transl"), members, None), SOMA77


def gemx(content: Mapping[str, Any], path: str | Path) -> tuple[MocapTree, Rig]:
    """``body_params_global`` {``global_orient`` [F, 3], ``body_pose`` [F, 228], ``transl`` [F, 3]}; Y up."""
    members = Members({**content["body_params_global"], **({"fps": content["fps"]} if "fps" in content else {})}, path)
    rotations = axis_angle_to_matrix(soma_poses(members))
    return _tree(SOMA77, rotations, members.numbers("transl").reshape(-1, 3), members, None), SOMA77


def soma_poses(members: Members) -> Floats:
    """Axis-angles [F, 77, 3] of ``global_orient`` and ``body_pose``."""
    root, body = members.numbers("global_orient").reshape(-1, 3), members.numbers("body_pose")
    if not len(root) or body.size != 76 * root.size:
        got = "×".join(map(str, body.shape))
        raise InputError("body_pose", expected=f"{len(root)} × 76 axis-angles of SOMA", got=got, file=members.path)
    return np.concatenate([root[:, None], body.reshape(-1, 76, 3)], 1)


def _tree(rig: Rig, rotations: Floats, path: Floats, members: Members, joints: Floats | None) -> MocapTree:
    if path.shape != (len(rotations), 3) or (joints is not None and len(joints) != len(rotations)):
        lengths = [len(path)] if joints is None else [len(path), len(joints)]
        got = " and ".join(map(str, lengths))
        raise InputError("positions", expected=f"{len(rotations)}, as there are rotations", got=got, file=members.path)
    fps = frame_rate(members)
    notes: tuple[str, ...] = ()
    if fps is None:
        fps, notes = _FPS, (_NOTE,)
    if joints is None:
        return MocapTree(rig.names, rig.parents, neutral_offsets(rig), rotations, path, fps, (*notes, _AVERAGE))
    tree = MocapTree(rig.names, rig.parents, neutral_offsets(rig), rotations, path, fps)
    return world_tree(rig.names, rig.parents, joints, tree.global_rotations(), fps, notes)


def neutral_offsets(rig: Rig) -> Floats:
    """Offsets [J, 3] m of the neutral body's joints from their parents in the T-pose."""
    places = {name: np.array(place, np.float64) for name, place in _T_POSE.items()}
    places |= {name.replace("Left", "Right"): p * [-1, 1, 1] for name, p in places.items() if name.startswith("Left")}
    for name, parent in zip(SOMA77.names, SOMA77.parents):
        if name not in places:
            side = 1.0 if name.startswith("Left") else -1.0
            places[name] = places[SOMA77.names[parent]] + [side * _FINGER_STEP, 0, 0]
    return np.array(
        [
            places[name] - (places[rig.names[parent]] if parent >= 0 else places[name])
            for name, parent in zip(rig.names, rig.parents)
        ]
    )
