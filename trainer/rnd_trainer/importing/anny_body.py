"""Anny's default person (NAVER, Apache-2.0) as a template, by the package ``anny``."""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Z_UP_TO_Y_UP
from rnd_runtime.motion.skeleton import Skeleton

from .images import rotation_between

LICENSE = "Apache-2.0 (Anny, NAVER Corp.); its shapes CC0-1.0 (MakeHuman)"

# Mixamo's names → SMPL-H's.
_BODY = {"Hips": "pelvis", "Spine": "spine1", "Spine1": "spine2", "Spine2": "spine3", "Neck": "neck", "Head": "head"}
_SIDED = {
    "UpLeg": "hip",
    "Leg": "knee",
    "Foot": "ankle",
    "ToeBase": "foot",
    "Shoulder": "collar",
    "Arm": "shoulder",
    "ForeArm": "elbow",
    "Hand": "wrist",
}
_SIDED |= {f"Hand{f}{k}": f"{f.lower()}{k}" for f in ("Index", "Middle", "Pinky", "Ring", "Thumb") for k in "123"}
PHENOTYPE = ("gender", "age", "muscle", "weight", "height", "proportions")
ADULT = 2 / 3
"""``age`` of a young adult"""
_ARM = ("shoulder", "elbow", "wrist", "middle1")


class AnnyModel:
    """Anny, loaded once: some minutes the first time, when it fills its cache.

    Raises:
        InputError: the package ``anny`` is not installed.
    """

    def __init__(self) -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                import anny
        except ImportError as error:
            raise InputError("Anny is not installed", hint="pip install anny") from error
        self.model = anny.Anny(rig="mixamo", skinning_method="lbs")

    def body(self, **phenotype: float) -> Body:
        """The adult of a phenotype with SMPL-H's joint names, in a T-pose, Y up, facing +Z; 0.5 is the mean."""
        import torch

        model = self.model
        usual = {name: ADULT if name == "age" else 0.5 for name in PHENOTYPE}
        values = {name: torch.tensor([value]) for name, value in (usual | phenotype).items()}
        posed = model(phenotype_kwargs=values) if phenotype else model()
        vertices, joints = (
            posed[name][0].detach().numpy() @ Z_UP_TO_Y_UP.T for name in ("rest_vertices", "rest_bone_heads")
        )
        names = tuple(_smpl_name(label.removeprefix("mixamorig:")) for label in model.bone_labels)
        weights = np.zeros((len(vertices), len(names)))
        rows = np.arange(len(vertices))[:, None]
        np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
        faces = model.faces.numpy()
        if faces.shape[1] == 4:
            faces = np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]])
        skeleton = Skeleton(names, np.array(model.bone_parents, np.int32), joints)
        return _with_level_arms(Body(vertices, faces, weights.astype(np.float32), skeleton, LICENSE))


def anny_body() -> Body:
    """Anny's mean adult with SMPL-H's joint names, in a T-pose, Y up, facing +Z.

    Raises:
        InputError: the package ``anny`` is not installed.
    """
    return AnnyModel().body()


def _smpl_name(name: str) -> str:
    for prefix, side in (("Left", "left_"), ("Right", "right_")):
        if name.startswith(prefix):
            return side + _SIDED[name.removeprefix(prefix)]
    return _BODY[name]


def _with_level_arms(body: Body) -> Body:
    """``body`` with its arms along X, the rest pose of SMPL."""
    skeleton = body.skeleton
    rotations = np.tile(np.eye(3), (len(skeleton), 1, 1))
    for side, along in (("left_", 1.0), ("right_", -1.0)):
        parent = np.eye(3)  # the parent's world rotation
        for joint, child in pairwise(_ARM):
            a, b = skeleton.names.index(side + joint), skeleton.names.index(side + child)
            bone = skeleton.rest_joints[b] - skeleton.rest_joints[a]
            world = rotation_between(bone / np.linalg.norm(bone), np.array([along, 0.0, 0.0]))
            rotations[a], parent = parent.T @ world, world
    joints = skeleton.joint_transforms(rotations, np.zeros(3))[:, :3, 3]
    levelled = Skeleton(skeleton.names, skeleton.parents, joints)
    return Body(posed_vertices(body, rotations, np.zeros(3)), body.faces, body.skinning_weights, levelled, body.license)
