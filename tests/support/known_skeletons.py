"""The known motion on skeletons of other programs: writers of BVH and AMC."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from support.known_motion import FRAMES, MATRICES, PELVIS, SKELETON, Y_UP


def _zero_pose(spread: dict[str, float]) -> np.ndarray:
    """[24, 3, 3] world rotations from our rest pose to another, whose limbs are swung by ``spread`` rad.

    A bone is swung across its own direction: a file's zero pose shows where bones point, not how they are twisted.
    """
    turns = np.tile(np.eye(3), (24, 1, 1))
    for joint, parent in enumerate(SMPL_PARENTS):
        if joint:
            turns[joint] = turns[parent]
        if SMPL_NAMES[joint] in spread:
            bone = SKELETON.rest_joints[SMPL_PARENTS.index(joint)] - SKELETON.rest_joints[joint]
            across = np.array([0, 0, 1]) - bone[2] * bone / (bone @ bone)
            swing = Rotation.from_rotvec(spread[SMPL_NAMES[joint]] * across / np.linalg.norm(across))
            turns[joint] = turns[joint] @ swing.as_matrix()
    return turns


_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow")


def world_rotations(rotations: np.ndarray, skeleton: Skeleton = SKELETON) -> np.ndarray:
    """[F, J, 3, 3] of local ``rotations``."""
    return skeleton.joint_transforms(rotations, np.zeros((len(rotations), 3)))[..., :3, :3]


def degrees_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [...] in degrees between rotations [..., 3, 3]."""
    return np.degrees(np.arccos(np.clip(((a * b).sum((-1, -2)) - 1) / 2, -1, 1)))


def assert_same_poses(rotations: np.ndarray, expected: np.ndarray, degrees: float = 5.0, limbs: float = 1.0) -> None:
    """Local rotations [F, J, 3, 3] of ``SKELETON``: joints within ``degrees``, directions of limbs within ``limbs``."""
    ours, theirs = world_rotations(rotations), world_rotations(expected)
    apart = degrees_apart(ours, theirs).max(0)
    assert apart.max() < degrees, {name: round(float(a), 1) for name, a in zip(SMPL_NAMES, apart) if a >= degrees}
    for child, parent in enumerate(SMPL_PARENTS):
        if SMPL_NAMES[parent].endswith(_LIMBS):
            bone = SKELETON.rest_joints[child] - SKELETON.rest_joints[parent]
            bone /= np.linalg.norm(bone)
            cosines = ((ours[:, parent] @ bone) * (theirs[:, parent] @ bone)).sum(-1)
            assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < limbs, SMPL_NAMES[parent]


A_POSE = {"left_shoulder": -0.8, "right_shoulder": 0.8, "left_hip": 0.3, "right_hip": -0.3}


def write_bvh(
    path: Path, names: dict[str, str], *, axes=Y_UP, unit=1.0, spread=A_POSE, order="ZXY", t_pose=False, facing=None
) -> Path:
    """The known motion, turned by ``facing``, on a skeleton whose zero pose, axes, unit and names differ from ours."""
    facing = np.eye(3) if facing is None else facing
    zero = _zero_pose(spread)
    offsets = np.zeros((24, 3))
    world = np.empty((FRAMES, 24, 3, 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        world[:, joint] = facing @ MATRICES[:, 0] if joint == 0 else world[:, parent] @ MATRICES[:, joint]
        if joint:
            offsets[joint] = unit * axes @ zero[parent] @ (SKELETON.rest_joints[joint] - SKELETON.rest_joints[parent])
    turned = axes @ world @ np.swapaxes(zero, -1, -2) @ axes.T
    local = turned.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
        local[:, joint] = np.swapaxes(turned[:, parent], -1, -2) @ turned[:, joint]
    places = unit * PELVIS @ facing.T @ axes.T
    if t_pose:
        local = np.concatenate([_local_rest(zero, axes)[None], local])
        places = np.concatenate([places[:1], places])
    lines = ["HIERARCHY"]

    def write(joint: int, indent: str) -> None:
        lines.append(f"{indent}{'JOINT' if joint else 'ROOT'} {names.get(SMPL_NAMES[joint], f'extra{joint}')}")
        lines.append(f"{indent}{{")
        x, y, z = offsets[joint]
        lines.append(f"{indent}\tOFFSET {x:.8f} {y:.8f} {z:.8f}")
        place = "" if joint else "Xposition Yposition Zposition "
        lines.append(f"{indent}\tCHANNELS {3 if joint else 6} {place}" + " ".join(f"{axis}rotation" for axis in order))
        children = [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint]
        for child in children:
            write(child, indent + "\t")
        if not children:
            lines.extend([f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET 0 0.05 0", f"{indent}\t}}"])
        lines.append(f"{indent}}}")
        sequence.append(joint)

    sequence: list[int] = []
    write(0, "")
    depth_first: list[int] = []
    stack = [0]
    while stack:
        joint = stack.pop()
        depth_first.append(joint)
        stack += [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint][::-1]
    lines += ["MOTION", f"Frames: {len(local)}", "Frame Time: 0.0083333"]
    for frame in range(len(local)):
        angles = [Rotation.from_matrix(local[frame, joint]).as_euler(order, degrees=True) for joint in depth_first]
        numbers = np.concatenate([places[frame], np.ravel(angles)])
        lines.append(" ".join(f"{number:.8f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def _local_rest(zero: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """[24, 3, 3] local rotations on top of the zero pose that give our rest pose."""
    turned = axes @ np.swapaxes(zero, -1, -2) @ axes.T
    local = turned.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
        local[joint] = turned[parent].T @ turned[joint]
    return local


def _namings() -> dict[str, dict[str, str]]:
    """For each naming of ``joint_names.toml`` its first name of every joint, by ours."""
    tables = tomllib.loads(resources.files("rnd_runtime.motion").joinpath("joint_names.toml").read_text("utf-8"))
    namings: dict[str, dict[str, str]] = {}
    for naming, table in tables.items():
        firsts = {
            joint: names if isinstance(names, str) else names[0] for joint, names in table.items() if joint != "sides"
        }
        namings[naming] = {
            joint.replace("*", side): name.replace("*", theirs)
            for joint, name in firsts.items()
            for side, theirs in zip(("left", "right"), table["sides"])
        }
    mixamo = namings["motionbuilder"] | {"spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2"}
    return namings | {"mixamo": {joint: f"mixamorig:{name}" for joint, name in mixamo.items()}}


NAMINGS = _namings()


def write_amc(folder: Path) -> Path:
    """The known motion on bones of their own axes, in inches of 0.45: CMU's way. Spread legs, as theirs are."""
    names = {**NAMINGS["acclaim"], "pelvis": "root"}
    zero = _zero_pose(A_POSE)
    unit = 0.45 / 0.0254
    rng = np.random.default_rng(0)
    # a joint with several children needs a bone to each of them: rigid ones without freedoms
    lines = [":version 1.10", ":name VICON", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["  order TX TY TZ RX RY RZ", "  axis XYZ", "  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    hierarchy, axes = [":hierarchy", "  begin"], {"root": np.eye(3)}
    ends = {child: parent for child, parent in enumerate(SMPL_PARENTS) if child}
    bone_of = {0: "root"}
    for child, parent in ends.items():
        offset = unit * zero[parent] @ (SKELETON.rest_joints[child] - SKELETON.rest_joints[parent])
        link = f"link{child}"
        length = np.linalg.norm(offset)
        x, y, z = offset / length
        lines += ["  begin", f"     id {child}", f"     name {link}", f"     direction {x:.9f} {y:.9f} {z:.9f}"]
        lines += [f"     length {length:.9f}", "     axis 0 0 0  XYZ", "  end"]
        name = names[SMPL_NAMES[child]]
        turn = rng.uniform(-90, 90, 3)
        axes[name] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        lines += ["  begin", f"     id {100 + child}", f"     name {name}", "     direction 0 1 0", "     length 0"]
        lines += [f"     axis {turn[0]:.9f} {turn[1]:.9f} {turn[2]:.9f}  XYZ", "    dof rx ry rz"]
        lines += ["    limits (-160.0 20.0)", "           (-70.0 70.0)", "           (-60.0 70.0)", "  end"]
        hierarchy += [f"    {bone_of[parent]} {link}", f"    {link} {name}"]
        bone_of[child] = name
    (folder / "02.asf").write_text("\n".join([*lines, *hierarchy, "  end"]) + "\n")

    world = np.empty((FRAMES, 24, 3, 3))
    motion = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for joint, parent in enumerate(SMPL_PARENTS):
        world[:, joint] = MATRICES[:, joint] if joint == 0 else world[:, parent] @ MATRICES[:, joint]
    turned = world @ np.swapaxes(zero, -1, -2)
    for frame in range(FRAMES):
        motion.append(str(frame + 1))
        for joint, parent in enumerate(SMPL_PARENTS):
            local = turned[frame, joint] if joint == 0 else turned[frame, parent].T @ turned[frame, joint]
            name = bone_of[joint]
            own = axes[name].T @ local @ axes[name]
            numbers = Rotation.from_matrix(own).as_euler("xyz", degrees=True)  # fixed axes, x first
            place = unit * PELVIS[frame] if joint == 0 else []
            motion.append(" ".join([name, *(f"{number:.8f}" for number in [*place, *numbers])]))
    (folder / "02_01.amc").write_text("\n".join(motion) + "\n")
    return folder / "02_01.amc"
