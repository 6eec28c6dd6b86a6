"""A known motion on the skeletons that programs write: any zero pose, any axes of the bones, any rolls."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rnd_runtime.motion.readers.tree import MocapTree
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from support.known_motion import SKELETON
from support.known_skeletons import world_rotations

MATCHED = {name: joint for joint, name in enumerate(SMPL_NAMES)}


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """[count, 3, 3]"""
    return Rotation.random(count, random_state=rng).as_matrix().reshape(-1, 3, 3)


def tree(
    rotations: np.ndarray, pelvis: np.ndarray, zero: np.ndarray, skeleton: Skeleton = SKELETON, fps: float = 30.0
) -> MocapTree:
    """Local ``rotations`` [F, 24, 3, 3] with the bones' axes rotated by ``zero`` [24, 3, 3]: joints do not move."""
    return tree_of_world(world_rotations(rotations, skeleton) @ np.swapaxes(zero, -1, -2), pelvis, zero, skeleton, fps)


def tree_of_world(
    world: np.ndarray, pelvis: np.ndarray, zero: np.ndarray, skeleton: Skeleton = SKELETON, fps: float = 30.0
) -> MocapTree:
    """World rotations [F, 24, 3, 3] of the file's bones, whose offsets are those of ``zero`` [24, 3, 3]."""
    offsets, local = np.zeros((24, 3)), world.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
        offsets[joint] = zero[parent] @ (skeleton.rest_joints[joint] - skeleton.rest_joints[parent])
        local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
    return MocapTree(SMPL_NAMES, SMPL_PARENTS, offsets, local, pelvis, fps)


def rolled(world: np.ndarray, rolls: np.ndarray, skeleton: Skeleton = SKELETON) -> np.ndarray:
    """``world`` [F, 24, 3, 3] with bones that have one child rolled about it by ``rolls`` [F, 24] rad."""
    world = world.copy()
    for joint in range(24):
        children = [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint]
        if len(children) == 1:
            bone = skeleton.rest_joints[children[0]] - skeleton.rest_joints[joint]
            vectors = rolls[:, joint, None] * bone / np.linalg.norm(bone)
            world[:, joint] = world[:, joint] @ Rotation.from_rotvec(vectors).as_matrix()
    return world
