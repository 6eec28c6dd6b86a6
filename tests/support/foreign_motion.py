"""A walk on other programs' skeletons, and writers of it in their files."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rnd_runtime.motion.formats.rigs import MHR127, SOMA77, Rig
from rnd_runtime.motion.formats.soma import neutral_offsets
from rnd_runtime.motion.motion import load_motion
from support.known_motion import SKELETON, write_npz, write_pickle
from support.paths import ASSETS

FRAMES = 24
_WALK = load_motion(ASSETS / "walk.npz", SKELETON)
MATRICES = _WALK.rotations[: 2 * FRAMES : 2]
"""[F, 24, 3, 3] local rotations"""
PELVIS = _WALK.translations[: 2 * FRAMES : 2] + SKELETON.rest_joints[0]
WORLD = SKELETON.joint_transforms(MATRICES, PELVIS - SKELETON.rest_joints[0])
JOINTS = WORLD[..., :3, 3]
"""[F, 24, 3] m, where the walk's joints are"""
FLIP = np.diag([1.0, -1, -1])  # right, up, backward ↔ right, down, forward
LEVEL = np.array([0.4, 0.1, -4.0])  # m, from a level camera to the person's beginning


def on_rig(
    names: Sequence[str], parents: Sequence[int], rest: np.ndarray, ours: Mapping[str, str]
) -> tuple[np.ndarray, np.ndarray]:
    """World rotations [F, J, 3, 3] relative to the rest pose ``rest`` [J, 3], and positions [F, J, 3].

    A bone points where the walk's does; joints without one of ours follow their parents.
    """
    index = {name: k for k, name in enumerate(SKELETON.names)}
    rotations, positions = np.empty((FRAMES, len(names), 3, 3)), np.empty((FRAMES, len(names), 3))
    aligned = np.tile(np.eye(3), (len(names), 1, 1))
    for joint, name in enumerate(names):
        parent = parents[joint]
        if parent >= 0:
            aligned[joint] = aligned[parent]
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ (rest[joint] - rest[parent])
        else:
            positions[:, joint] = PELVIS
        if name not in ours:
            rotations[:, joint] = rotations[:, parent] if parent >= 0 else np.eye(3)
            continue
        known = index[ours[name]]
        child = _limb_below(known)
        theirs = next(
            (k for k, other in enumerate(names) if child >= 0 and ours.get(other) == SKELETON.names[child]), -1
        )
        if theirs >= 0:
            bone = SKELETON.rest_joints[child] - SKELETON.rest_joints[known]
            aligned[joint] = _swing(rest[theirs] - rest[joint], bone)
        rotations[:, joint] = WORLD[:, known, :3, :3] @ aligned[joint]
    return rotations, positions


def _limb_below(known: int) -> int:
    """Our joint below a limb's joint, −1 for trunk and ends."""
    if SKELETON.names[known].split("_")[-1] not in ("collar", "shoulder", "elbow", "hip", "knee", "ankle"):
        return -1
    return next(k for k, parent in enumerate(SKELETON.parents) if parent == known)


def _swing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation from ``a`` to ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return Rotation.from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, a @ b)).as_matrix()


def rest_of(rig: Rig) -> np.ndarray:
    """[J, 3] m of SOMA's T-pose."""
    rest = neutral_offsets(rig)
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            rest[joint] += rest[parent]
    return rest


SOMA_WORLD, SOMA_JOINTS = on_rig(SOMA77.names, SOMA77.parents, rest_of(SOMA77), SOMA77.ours)


def local_of(rotations: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """World ``rotations`` in the parents' axes."""
    local = rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = rotations[:, parent].swapaxes(-1, -2) @ rotations[:, joint]
    return local


def write_kimodo(folder: Path, joints: bool = True) -> Path:
    """Kimodo's .npz; ``posed_joints`` of somebody else's bones, 10 % longer."""
    members = {
        "local_rot_mats": local_of(SOMA_WORLD, SOMA77.parents).astype(np.float32),
        "root_positions": PELVIS.astype(np.float32),
        "foot_contacts": np.zeros((FRAMES, 4)),
    }
    if joints:
        members["posed_joints"] = (PELVIS[:, None] + 1.1 * (SOMA_JOINTS - PELVIS[:, None])).astype(np.float32)
    return write_npz(folder / "kimodo.npz", **members)


def soma_axis_angles() -> np.ndarray:
    local = local_of(SOMA_WORLD, SOMA77.parents)
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(FRAMES, 77, 3)


def write_gemx(folder: Path) -> Path:
    """GEM-X' hpe_results.pt, as torch saves it."""
    poses = soma_axis_angles().astype(np.float32)
    world = {
        "global_orient": torch.tensor(poses[:, 0]),
        "body_pose": torch.tensor(poses[:, 1:].reshape(FRAMES, 228)),
        "transl": torch.tensor(PELVIS, dtype=torch.float32),
        "identity_coeffs": torch.zeros(FRAMES, 45),
        "scale_params": torch.zeros(FRAMES, 68),
    }
    in_camera = world | {"global_orient": torch.tensor(before_a_camera(poses[:, 0]))}
    in_camera["transl"] = torch.tensor((PELVIS - PELVIS[0] * [1, 0, 1] + LEVEL) @ FLIP)
    K = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]).repeat(FRAMES, 1, 1)
    torch.save({"body_params_global": world, "body_params_incam": in_camera, "K_fullimg": K}, folder / "hpe_results.pt")
    return folder / "hpe_results.pt"


def before_a_camera(root: np.ndarray) -> np.ndarray:
    """Root axis-angles [F, 3] in a level camera's axes."""
    return (Rotation.from_matrix(FLIP) * Rotation.from_rotvec(root)).as_rotvec()


def write_somax(folder: Path) -> Path:
    """SOMA-X' own .npz, in centimetres, with its virtual root."""
    poses = np.concatenate([np.zeros((FRAMES, 1, 3)), soma_axis_angles()], 1)
    names = np.array(["Root", *SOMA77.names])
    orient = np.tile(np.eye(3), (78, 1, 1))
    extra = {"identity_model_type": "mhr", "identity_coeffs": np.zeros((1, 45)), "unit": "centimeters"}
    return write_npz(
        folder / "soma.npz", poses=poses, transl=100 * PELVIS, joint_names=names, joint_orient=orient, fps=30, **extra
    )


def _mhr() -> tuple[np.ndarray, np.ndarray]:
    """World rotations and positions of MHR's joints, whose bones' axes are any."""
    soma = dict(zip(SOMA77.names, rest_of(SOMA77)))
    by_ours = {ours: soma[theirs] for theirs, ours in SOMA77.ours.items()}
    rest = np.zeros((len(MHR127.names), 3))
    for joint, (name, parent) in enumerate(zip(MHR127.names, MHR127.parents)):
        if name in MHR127.ours:
            rest[joint] = by_ours[MHR127.ours[name]]
        elif parent > 0:
            rest[joint] = rest[parent] + [0.0, 0.0, 0.01]
    for side in "lr":  # beyond the joints that SMPL has
        wrist = rest[MHR127.names.index(f"{side}_wrist")]
        for finger, across in (("index", 0.02), ("pinky", -0.03)):
            sign = 1 if side == "l" else -1
            rest[MHR127.names.index(f"{side}_{finger}1")] = wrist + np.array([0.07 * sign, 0, across])
        rest[MHR127.names.index(f"{side}_wrist_twist")] = 0.5 * (wrist + rest[MHR127.names.index(f"{side}_lowarm")])
    parents = [-1 if name == "body_world" else parent for name, parent in zip(MHR127.names, MHR127.parents)]
    rotations, positions = on_rig(MHR127.names[1:], [p - 1 for p in parents[1:]], rest[1:], MHR127.ours)
    axes = Rotation.random(len(MHR127.names), random_state=7).as_matrix()
    rotations = np.concatenate([np.tile(np.eye(3), (FRAMES, 1, 1, 1)), rotations], 1)
    return rotations @ axes, np.concatenate([np.zeros((FRAMES, 1, 3)), positions], 1)


MHR_WORLD, MHR_JOINTS = _mhr()


def sam3d_people(rotations_flipped: bool = False) -> list[list[dict[str, np.ndarray]]]:
    """SAM 3D Body's outputs per image: joints around the origin in the camera's axes, rotations in MHR's own."""
    people = []
    for k in range(FRAMES):
        around = MHR_JOINTS[k] - MHR_JOINTS[k, 1]
        around[0] = 0
        rotations = FLIP @ MHR_WORLD[k] if rotations_flipped else MHR_WORLD[k]
        ours = {
            "pred_cam_t": ((PELVIS[k] - PELVIS[0] * [1, 0, 1] + LEVEL) @ FLIP).astype(np.float32),
            "focal_length": np.float32(900),
            "mhr_model_params": np.zeros(204, np.float32),
            "shape_params": np.zeros(45, np.float32),
            "pred_joint_coords": (around @ FLIP).astype(np.float32),
            "pred_global_rots": rotations.astype(np.float32),
        }
        behind = ours | {"pred_cam_t": ours["pred_cam_t"] + np.float32([1, 0, 3])}
        people.append([behind, ours] if k % 2 else [ours, behind])
    return people


def write_sam3d(folder: Path, form: str = "list") -> Path:
    """In the forms in which people keep it."""
    people = sam3d_people(rotations_flipped=form == "flipped")
    if form == "folder":
        (folder / "sam3d").mkdir()
        for k, persons in enumerate(people):
            write_pickle(folder / "sam3d" / f"{7 + k:06d}.pkl", persons)
        return folder / "sam3d"
    if form == "json":
        (folder / "sam3d").mkdir()
        for k, persons in enumerate(people):
            plain = [{name: np.asarray(value).tolist() for name, value in person.items()} for person in persons]
            (folder / "sam3d" / f"{k:06d}.json").write_text(json.dumps({"people": plain}))
        return folder / "sam3d"
    ours = [persons[k % 2] for k, persons in enumerate(people)]
    if form == "npz":
        return write_npz(folder / "sam3d.npz", **{name: np.stack([one[name] for one in ours]) for name in ours[0]})
    if form == "dict":
        return write_pickle(
            folder / "sam3d.pkl", {f"{k:06d}.jpg": {"outputs": persons} for k, persons in enumerate(people)}
        )
    return write_pickle(folder / "sam3d.pkl", people)


def write_glb(folder: Path, names: Sequence[str], extensions: dict | None = None, name: str = "a.glb", **how) -> Path:
    """The walk as glTF: nodes in random axes under a small, turned armature; 25 frames per second.

    Args:
        names: of the 24 joints.
        how: ``method`` of interpolation, ``scale`` of the armature.
    """
    method, scale = how.get("method", "LINEAR"), how.get("scale", 0.01)
    axes = Rotation.random(24, random_state=3)
    turn = Rotation.from_euler("x", -90, degrees=True)
    parents = [int(parent) for parent in SKELETON.parents]
    world = [turn.inv() * Rotation.from_matrix(WORLD[:, k, :3, :3]) * axes[k] for k in range(24)]
    places = turn.inv().apply(JOINTS.reshape(-1, 3)).reshape(JOINTS.shape) / scale
    nodes: list[dict] = [
        {"name": "Armature", "rotation": turn.as_quat().tolist(), "scale": [scale] * 3, "children": [1]}
    ]
    times = np.arange(FRAMES, dtype="<f4") / 25
    blobs, accessors, views, channels, samplers = [times.tobytes()], [], [], [], []

    def accessor(values: np.ndarray, kind: str) -> int:
        if values is not times:
            blobs.append(np.ascontiguousarray(values, "<f4").tobytes())
        offset = sum(map(len, blobs[:-1]))
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blobs[-1])})
        accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": kind})
        return len(accessors) - 1

    clock = accessor(times, "SCALAR")
    for joint in range(24):
        parent = parents[joint]
        if parent < 0:
            rotations, offset = world[joint], places[:, 0]
        else:
            rotations = world[parent].inv() * world[joint]
            offset = world[parent].inv().apply(places[:, joint] - places[:, parent])
        children = [k + 1 for k, above in enumerate(parents) if above == joint]
        nodes.append(
            {"name": names[joint], "translation": offset[0].tolist(), "rotation": rotations[0].as_quat().tolist()}
        )
        nodes[-1] |= {"children": children} if children else {}
        quaternions = rotations.as_quat()
        if method == "CUBICSPLINE":
            flat = np.zeros_like(quaternions)
            quaternions = np.stack([flat, quaternions, flat], 1).reshape(-1, 4)
        samplers.append({"input": clock, "output": accessor(quaternions, "VEC4"), "interpolation": method})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": joint + 1, "path": "rotation"}})
    samplers.append({"input": clock, "output": accessor(places[:, 0], "VEC3"), "interpolation": "LINEAR"})
    channels.append({"sampler": len(samplers) - 1, "target": {"node": 1, "path": "translation"}})
    binary = b"".join(blobs)
    document = {
        "asset": {"version": "2.0"},
        "nodes": nodes,
        "scenes": [{"nodes": [0]}],
        "skins": [{"joints": list(range(1, 25))}],
        "animations": [{"name": "walk", "channels": channels, "samplers": samplers}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
        **({"extensions": extensions} if extensions else {}),
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path = folder / name
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def humanml_numbers(joints: np.ndarray) -> np.ndarray:
    """HumanML3D's 263 numbers of joints [F, 22, 3] m, Y up: its root, joints and velocities; other columns are zero.

    Written from its definitions: the heading turns the hips' and shoulders' forward to +Z.
    """
    across = joints[:, 1] - joints[:, 2] + joints[:, 16] - joints[:, 17]
    heading = np.arctan2(-across[:, 2], across[:, 0])  # of the left-hand axis, about Y
    heading = np.unwrap(heading)

    def turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Rotated by −``angle`` about Y, into the heading's axes."""
        cosine, sine = np.cos(angle), np.sin(angle)
        shape = (-1, *(1,) * (points.ndim - 2))
        cosine, sine = cosine.reshape(shape), sine.reshape(shape)
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([cosine * x - sine * z, y, sine * x + cosine * z], -1)

    numbers = np.zeros((len(joints), 263))
    # its quaternions (cos a, 0, sin a, 0) take world to heading; a grows by minus half the heading's change
    numbers[:-1, 0] = -0.5 * np.diff(heading)
    steps = np.diff(joints[:, 0], axis=0)
    numbers[:-1, 1:3] = turned(steps, heading[1:] - heading[0])[:, [0, 2]]
    numbers[:, 3] = joints[:, 0, 1]
    local = joints - joints[:, :1] * [1, 0, 1]
    numbers[:, 4:67] = turned(local, heading - heading[0])[:, 1:].reshape(len(joints), -1)
    return numbers
