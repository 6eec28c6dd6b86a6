"""Small valid motions of later programs, and cameras: Kimodo, SAM 3D Body, HumanML3D, glTF, nerfstudio."""

from __future__ import annotations

import json
import pickle  # noqa: TID251  # writes what others' programs write
from pathlib import Path

import numpy as np

from rnd_runtime.motion.formats.rigs import MHR127, SOMA77
from rnd_runtime.motion.skeleton import Skeleton

FRAMES = 3


def write_rigs(folder: Path, skeleton: Skeleton) -> None:
    """Write ``kimodo.npz``, ``sam3d.pkl``, ``humanml.npy``, ``walk.glb``, ``camera.glb`` and ``transforms.json``."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (FRAMES, len(SOMA77.names), 1, 1))
    np.savez(folder / "kimodo.npz", local_rot_mats=rotations, root_positions=np.tile([0.0, 1, 0], (FRAMES, 1)))
    (folder / "sam3d.pkl").write_bytes(pickle.dumps([[_person(skeleton)] for _ in range(FRAMES)], protocol=4))
    numbers = np.zeros((FRAMES, 263), np.float32)
    numbers[:, 3] = skeleton.rest_joints[0, 1]
    numbers[:, 4:67] = (skeleton.rest_joints[1:22] - skeleton.rest_joints[0] * [1, 0, 1]).reshape(-1)
    np.save(folder / "humanml.npy", numbers)
    _write_glb(folder / "walk.glb", skeleton)
    _write_camera(folder / "camera.glb")
    pose = np.diag([1.0, 1, 1, 1])
    pose[:3, 3] = 0, 0, 3
    views = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k in range(FRAMES)]
    content = {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": views}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def _person(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """SAM 3D Body's of one person, 3 m before the camera; joints that SMPL lacks lie 1 cm ahead of their parents."""
    ours = dict(zip(skeleton.names, skeleton.rest_joints - skeleton.rest_joints[0]))
    joints = np.zeros((len(MHR127.names), 3), np.float32)
    for joint, (name, parent) in enumerate(zip(MHR127.names, MHR127.parents)):
        if name in MHR127.ours:
            joints[joint] = ours[MHR127.ours[name]]
        elif parent > 0:
            joints[joint] = joints[parent] + [0, 0, 0.01]
    rotations = np.tile(np.eye(3, dtype=np.float32), (len(joints), 1, 1))
    camera = {"pred_cam_t": np.array([0.0, 0, 3]), "focal_length": np.array(900.0)}
    return {"pred_joint_coords": joints * np.array([1.0, -1, -1]), "pred_global_rots": rotations, **camera}


def _write_glb(path: Path, skeleton: Skeleton) -> None:
    """A skin and an animation of its rotations, by the writer of ``rnd-convert``."""
    from rnd_viewer.convert.glb import FLOAT, GlbBuilder

    builder, nodes, channels, samplers = GlbBuilder(), [], [], []
    times = builder.accessor(np.arange(FRAMES) / 30, "SCALAR", FLOAT, target=None, bounds=True)
    still = builder.accessor(np.tile([0.0, 0, 0, 1], (FRAMES, 1)), "VEC4", FLOAT, target=None)
    for joint, parent in enumerate(skeleton.parents):
        offset = skeleton.rest_joints[joint] - (skeleton.rest_joints[parent] if joint else 0)
        below = [int(child) for child in np.flatnonzero(skeleton.parents == joint)]
        nodes.append({"name": skeleton.names[joint], "translation": offset.tolist()})
        nodes[-1] |= {"children": below} if below else {}
        samplers.append({"input": times, "output": still, "interpolation": "LINEAR"})
        channels.append({"sampler": joint, "target": {"node": joint, "path": "rotation"}})
    animations = [{"channels": channels, "samplers": samplers}]
    skins = [{"joints": list(range(len(skeleton)))}]
    builder.write(path, {"nodes": nodes, "scenes": [{"nodes": [0]}], "skins": skins, "animations": animations})


def _write_camera(path: Path) -> None:
    """A camera that moves."""
    from rnd_viewer.convert.glb import FLOAT, GlbBuilder

    builder = GlbBuilder()
    times = builder.accessor(np.arange(FRAMES) / 30, "SCALAR", FLOAT, target=None, bounds=True)
    places = builder.accessor(np.tile([0.0, 1, 3], (FRAMES, 1)), "VEC3", FLOAT, target=None)
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    lens = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": places}]}
    builder.write(path, {"nodes": [{"camera": 0}], "cameras": [lens], "animations": [animation]})
