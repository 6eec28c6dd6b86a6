"""Placement of a data set in the capture's world: Y up, one body, a pose for every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import slerp_matrices
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.smpl import SMPL_REST_ROOT, SMPLX_REST_ROOT

from .body_models import BodyModel
from .dataset import ImportedDataset
from .images import rotation_between
from .poses import Poses, on_body

Floats = NDArray[np.float64]

UP_AXES = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}
SNAP_COSINE = np.cos(np.radians(30))
"""a mean up direction within 30° of an axis is snapped to it"""
MAX_FILLED = 100_000
"""largest number of interpolated poses: an hour of video"""


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """Body, motion and cameras of a data set in a world with Y up; motion frame 0 is the first pose."""

    body: Body
    motion: Motion
    cameras: dict[str, Camera]
    rotation: Floats  # [3, 3] from the source's world to the capture's
    notes: list[str]  # assumptions, one sentence each


def place_scene(dataset: ImportedDataset, model: BodyModel, up: str | None = None) -> PlacedScene:
    """The scene of ``dataset`` with the body of ``model``; frames between poses are slerped.

    ``up`` is the source's up axis ("y", "-z", …). Default: the direction of the poses' pelvises.
    """
    poses, notes = dataset.poses, list(dataset.notes)
    if poses.fit is not None:
        poses = on_body(poses, model.shaped(None).skeleton, model.family)
    same_family = model.family == poses.family or (model.family, poses.family) == ("SMPL-H", "SMPL")
    body = model.shaped(poses.betas if same_family else None)
    rest = body.skeleton.rest_joints[0]
    if not same_family and not _of_its_own(poses, body):
        rest = SMPLX_REST_ROOT if poses.family == "SMPL-X" else SMPL_REST_ROOT
        notes.append(
            f"the poses are {poses.family}'s and the body is not: shape ignored, {poses.family}'s mean pelvis assumed"
        )
    rotations = _match_joints(poses, body)
    rotation = _upright(rotations[:, 0], up, notes)
    rotations[:, 0] = rotation @ rotations[:, 0]
    translations = poses.root(rest) @ rotation.T - body.skeleton.rest_joints[0]
    motion = _interpolated(poses.frames, rotations, translations, body, dataset.fps, notes)
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    cameras = {
        name: replace(lens.camera, world_to_camera=lens.camera.world_to_camera @ inverse)
        for name, lens in dataset.lenses.items()
    }
    return PlacedScene(body, motion, cameras, rotation, notes)


def _of_its_own(poses: Poses, body: Body) -> bool:
    """Whether ``poses`` are of a body with these joints, as ``motion.save_motion`` writes them."""
    return poses.named and poses.convention == "smpl" and set(poses.joint_names) == set(body.skeleton.names)


def _match_joints(poses: Poses, body: Body) -> Floats:
    """Rotations [F, J, 3, 3] in the body's joint order, the identity for joints without poses."""
    rotations = np.tile(np.eye(3), (len(poses.frames), len(body.skeleton), 1, 1))
    columns = {name: k for k, name in enumerate(poses.joint_names)}
    matched = 0
    for joint, name in enumerate(body.skeleton.names):
        column = 0 if joint == 0 else columns.get(name)
        if column is not None:
            rotations[:, joint] = poses.rotations[:, column]
            matched += 1
    if matched < 2:
        expected, got = f"some of {', '.join(poses.joint_names[:4])}, …", ", ".join(body.skeleton.names[:4])
        raise InputError("joints of the body", expected=expected, got=got)
    return rotations


def _upright(root: Floats, up: str | None, notes: list[str]) -> Floats:
    """Rotation [3, 3] to Y from the up axis ``up``, or from the mean up direction of ``root`` [F, 3, 3]."""
    if up is not None:
        direction = np.array(UP_AXES[up], np.float64)
    else:
        mean = root[:, :, 1].mean(0)
        mean /= max(float(np.linalg.norm(mean)), 1e-9)
        axis = int(np.abs(mean).argmax())
        if abs(mean[axis]) >= SNAP_COSINE:
            direction = np.zeros(3)
            direction[axis] = np.sign(mean[axis])
            name = ("-" if mean[axis] < 0 else "") + "xyz"[axis]
            notes.append(f"{name} of the source taken for up, as the person stands along it")
        else:
            direction = mean
            notes.append("the source's world is tilted: rotated so that the person stands along Y on average")
    target = np.array([0.0, 1.0, 0.0])
    if direction @ target < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    return rotation_between(direction, target)


def _interpolated(
    frames: NDArray[np.int64], rotations: Floats, translations: Floats, body: Body, fps: float, notes: list[str]
) -> Motion:
    """Motion with a pose for every frame from first to last, missing ones slerped."""
    missing = int(frames[-1]) - int(frames[0]) + 1 - len(frames)
    if missing > MAX_FILLED:
        got = f"{missing} between {frames[0]} and {frames[-1]}"
        raise InputError("frames of the poses", expected=f"at most {MAX_FILLED} missing", got=got)
    every = np.arange(frames[0], frames[-1] + 1)
    after = np.minimum(np.searchsorted(frames, every, side="right"), len(frames) - 1)
    before = np.maximum(np.searchsorted(frames, every, side="right") - 1, 0)
    t = ((every - frames[before]) / np.maximum(frames[after] - frames[before], 1))[:, None]
    if missing:
        notes.append(f"{missing} of {len(every)} poses are interpolated")
    filled = slerp_matrices(rotations[before], rotations[after], t)
    return Motion(filled, (1 - t) * translations[before] + t * translations[after], fps, body.skeleton.names)
