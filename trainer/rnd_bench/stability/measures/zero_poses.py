"""Row P18: recordings whose zero pose and bones' axes are any."""

from __future__ import annotations

import numpy as np

from rnd_bench.scenes.psnr import Floats
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, below, result
from rnd_runtime.core.rotations import quaternion_to_matrix
from rnd_runtime.motion.readers.tree import MocapTree
from rnd_runtime.motion.retarget import retarget
from rnd_runtime.motion.skeleton import Skeleton

LIMBS = ("_shoulder", "_elbow", "_hip", "_knee", "_ankle")
POSES, FRAMES = 200, 40


def any_zero_pose(subject: Subject) -> Result:
    """P18: the capture's motion from random zero poses, a random frame for each bone, joints where they were."""
    motion, rng = subject.capture.motion_for(subject.avatar.skeleton), np.random.default_rng(7)
    skeleton, every = subject.avatar.skeleton, -(-motion.frame_count // FRAMES)
    pelvis = motion.translations[::every] + skeleton.rest_joints[0]
    world, fps = _world(motion.rotations[::every], skeleton), motion.fps / every
    matched = {name: joint for joint, name in enumerate(skeleton.names)}
    found, plain = [], 0.0
    for _ in range(subject.few(2, POSES)):
        zero = quaternion_to_matrix(rng.normal(size=(len(skeleton), 4)))
        tree = _recorded(world, pelvis, zero, skeleton, fps)
        solved = retarget(tree, skeleton, matched)
        found.append(_world(solved.rotations, skeleton))
        plain = max(plain, _degrees(_world(tree.rotations, skeleton), world))
    name = f"{len(found)} zero poses of one motion"
    usual = np.median(found, axis=0)
    baseline = ("zero pose taken for rest", plain)
    return result(
        below(f"{name}: rotations differ", max(_degrees(one, usual) for one in found), 0.1, "°"),
        below(f"{name}: limbs' directions off", max(_bones_apart(one, world, skeleton) for one in found), 1, "°"),
        below(f"{name}: rotations off", max(_degrees(one, world) for one in found), 5, "°", baseline=baseline),
    )


def _recorded(world: Floats, pelvis: Floats, zero: Floats, skeleton: Skeleton, fps: float) -> MocapTree:
    """The bones of ``world`` [F, J, 3, 3] with axes rotated by ``zero`` [J, 3, 3]."""
    bones = world @ np.swapaxes(zero, -1, -2)
    offsets, local = np.zeros((len(skeleton), 3)), bones.copy()
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        offsets[joint] = zero[parent] @ (skeleton.rest_joints[joint] - skeleton.rest_joints[parent])
        local[:, joint] = np.swapaxes(bones[:, parent], -1, -2) @ bones[:, joint]
    return MocapTree(skeleton.names, tuple(map(int, skeleton.parents)), offsets, local, pelvis, fps)


def _world(rotations: Floats, skeleton: Skeleton) -> Floats:
    return np.asarray(skeleton.joint_transforms(rotations, np.zeros((len(rotations), 3)))[..., :3, :3])


def _degrees(a: Floats, b: Floats) -> float:
    """Largest angle between rotations [..., 3, 3]."""
    cosines = ((a * b).sum((-1, -2)) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


def _bones_apart(a: Floats, b: Floats, skeleton: Skeleton) -> float:
    """Largest angle between limbs' directions, degrees."""
    worst = 0.0
    for child, parent in enumerate(skeleton.parents):
        if child and skeleton.names[parent].endswith(LIMBS):
            bone = skeleton.rest_joints[child] - skeleton.rest_joints[parent]
            cosines = ((a[:, parent] @ bone) * (b[:, parent] @ bone)).sum(-1) / (bone @ bone)
            worst = max(worst, float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max()))
    return worst
