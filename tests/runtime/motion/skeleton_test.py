"""Posing against a slow walk down the tree, and the refusals of a broken tree."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.skeleton import Skeleton, bone_transforms, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS

REST = np.random.default_rng(5).normal(size=(24, 3))


def _pose(seed: int) -> np.ndarray:
    return axis_angle_to_matrix(np.random.default_rng(seed).normal(size=(24, 3)))


def _posed_point(joint: int, point: np.ndarray, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Where a rest-pose point fixed to ``joint`` goes: turn it about each joint up to the root, then move."""
    while joint != -1:
        point = rotations[joint] @ (point - REST[joint]) + REST[joint]
        joint = SMPL_PARENTS[joint]
    return point + translation


def test_joint_transforms_carry_points_as_turning_about_every_ancestor_does():
    skeleton, rotations, translation = smpl_skeleton(REST), _pose(1), np.array([0.3, -0.2, 1.0])
    transforms = skeleton.joint_transforms(rotations, translation)
    for joint in range(24):
        offset = np.array([0.1, 0.2, -0.3])
        ours = (transforms[joint] @ [*offset, 1])[:3]
        assert_allclose(ours, _posed_point(joint, REST[joint] + offset, rotations, translation), atol=1e-12)


def test_root_turns_about_its_rest_position_and_is_then_translated():
    skeleton = Skeleton(("root",), [-1], [[1.0, 2.0, 3.0]])
    quarter = axis_angle_to_matrix([[0, 0, np.pi / 2]])
    transform = skeleton.joint_transforms(quarter, [10.0, 0.0, 0.0])[0]
    assert_allclose(transform @ [0, 0, 0, 1], [11, 2, 3, 1], atol=1e-12)
    assert_allclose(transform @ [1, 0, 0, 1], [11, 3, 3, 1], atol=1e-12)


def test_joint_transforms_of_a_batch_are_those_of_each_pose():
    skeleton = smpl_skeleton(REST)
    poses, moves = np.stack([_pose(1), _pose(2)]), np.array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
    both = skeleton.joint_transforms(poses, moves)
    assert both.shape == (2, 24, 4, 4)
    for k in range(2):
        assert (both[k] == skeleton.joint_transforms(poses[k], moves[k])).all()


def test_bone_transforms_of_the_rest_pose_are_the_identity():
    at_rest, identity = np.broadcast_to(np.eye(3), (24, 3, 3)), np.broadcast_to(np.eye(3, 4), (24, 3, 4))
    assert_allclose(bone_transforms(smpl_skeleton(REST), at_rest, np.zeros(3)), identity, atol=1e-6)


def test_bone_transforms_take_points_at_rest_to_posed_ones():
    skeleton, pose, move = smpl_skeleton(REST), _pose(4), np.array([0.5, 0.0, -1.0])
    bones = bone_transforms(skeleton, pose, move)
    assert bones.dtype == np.float32 and bones.shape == (24, 3, 4)
    for joint in (0, 7, 21):
        point = REST[joint] + [0.1, -0.1, 0.05]
        end = _posed_point(joint, point, pose, move)
        assert_allclose(bones[joint] @ [*point, 1], end, atol=3e-6)  # float32 of numbers up to 10


def test_turning_the_root_turns_every_bone_about_it():
    """Global rotations stay outside of the avatar: root-relative bone transforms do not change."""
    skeleton, pose = smpl_skeleton(REST), _pose(5)
    turn = axis_angle_to_matrix([0.2, 1.0, -0.4])
    turned = pose.copy()
    turned[0] = turn @ pose[0]
    before, after = (skeleton.joint_transforms(p, np.zeros(3)) for p in (pose, turned))
    assert_allclose(after[:, :3, :3], turn @ before[:, :3, :3], atol=1e-12)
    assert_allclose(after[:, :3, 3] - REST[0], (before[:, :3, 3] - REST[0]) @ turn.T, atol=1e-12)


def test_smpl_tree():
    assert len(SMPL_NAMES) == len(SMPL_PARENTS) == 24
    chains = {"left_hand": 8, "right_foot": 4, "head": 5}  # joints above, counted by hand
    for name, depth in chains.items():
        joint, above = SMPL_NAMES.index(name), 0
        while (joint := SMPL_PARENTS[joint]) != -1:
            above += 1
        assert above == depth, name
    left = [k for k, name in enumerate(SMPL_NAMES) if name.startswith("left")]
    for k in left:  # the right side mirrors the left
        twin = SMPL_NAMES.index(SMPL_NAMES[k].replace("left", "right"))
        parent = SMPL_NAMES[SMPL_PARENTS[k]].replace("left", "right")
        assert SMPL_NAMES[SMPL_PARENTS[twin]] == parent


@pytest.mark.parametrize(
    ("names", "parents", "joints", "words"),
    [
        ((), [], np.zeros((0, 3)), "at least one"),
        (("a", "b"), [-1], np.zeros((2, 3)), "parents [2]"),
        (("a", "b"), [-1, 0], np.zeros((2, 2)), "[2, 2]"),
        (("a", "a"), [-1, 0], np.zeros((2, 3)), "each name once"),
        (("a", "b"), [-1, -1], np.zeros((2, 3)), "earlier one"),
        (("a", "b"), [0, 0], np.zeros((2, 3)), "earlier one"),
        (("a", "b", "c"), [-1, 2, 1], np.zeros((3, 3)), "earlier one"),
        (("a", "b", "c"), [-1, 0, 10**30], np.zeros((3, 3)), "earlier one"),
        (("a", "b", "c"), [-1, 0, 2**32], np.zeros((3, 3)), "earlier one"),  # as int32 it is 0
        (("a", "b", "c"), [-1, 0, 0.5], np.zeros((3, 3)), "earlier one"),
        (("a", "b", "c"), [-1, 0, np.nan], np.zeros((3, 3)), "earlier one"),
        (("a", "b"), [-1, 0], [[0, 0, 0], [0, np.nan, 0]], "finite"),
    ],
)
def test_broken_trees_are_refused(names, parents, joints, words):
    with pytest.raises(InputError) as caught:
        Skeleton(names, np.array(parents), joints)
    assert words in str(caught.value)


def test_pose_of_another_joint_count_is_refused_with_both_counts():
    with pytest.raises(InputError) as caught:
        smpl_skeleton(REST).joint_transforms(np.zeros((23, 3, 3)), np.zeros(3))
    assert "24" in str(caught.value) and "23" in str(caught.value)
