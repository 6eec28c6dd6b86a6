"""Forearms that share twists: what turns, what must not, and that nothing jumps."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.posing.forearm import FREE, MAX_SHARE, share_twists, skinning_bones
from rnd_trainer.config import ModelConfig
from rnd_trainer.training.data import pose_input
from support.paths import ROOT
from support.tiny import body

ROUND_OFF = 1e-12
STEEPEST = 5.0  # change of what comes out over that of what goes in; measured 2.8
SKELETON = body().skeleton
NAMES = SKELETON.names


def _pose(**angles) -> np.ndarray:
    """[J, 3, 3] of degrees about a joint's forearm, and about what is across it."""
    rotations = np.tile(np.eye(3), (len(NAMES), 1, 1))
    for joint, (twist, bend) in angles.items():
        axis, across = _axes(joint.split("_")[0])
        turn = axis_angle_to_matrix(np.radians(bend) * across) @ axis_angle_to_matrix(np.radians(twist) * axis)
        rotations[NAMES.index(joint)] = turn
    return rotations


def _axes(side: str) -> tuple[np.ndarray, np.ndarray]:
    elbow, wrist = (SKELETON.rest_joints[NAMES.index(f"{side}_{end}")] for end in ("elbow", "wrist"))
    axis = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    across = np.cross(axis, [0.0, 0.0, 1.0])
    return axis, across / np.linalg.norm(across)


def _moved_twist(rotation: np.ndarray, axis: np.ndarray) -> float:
    """By the quaternion's swing and twist."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    along = np.array([x, y, z]) @ axis
    twist = (2 * np.arctan2(along, w) + np.pi) % (2 * np.pi) - np.pi
    beyond = max(abs(twist) - FREE, 0) / (np.pi - FREE)
    return float(np.sign(twist) * MAX_SHARE * np.sin(np.pi * beyond) ** 2 * min(1, 4 * (w * w + along * along)))


def test_it_turns_by_what_quaternions_say() -> None:
    rotations = axis_angle_to_matrix(np.random.default_rng(0).normal(0, 1.3, (300, len(NAMES), 3)))
    expected, turned = rotations.copy(), 0
    for pose in expected:
        for side in ("left", "right"):
            elbow, wrist = (NAMES.index(f"{side}_{end}") for end in ("elbow", "wrist"))
            axis, _ = _axes(side)
            angle = _moved_twist(pose[elbow], axis) - _moved_twist(pose[wrist], axis)
            turn = Rotation.from_rotvec(angle * axis).as_matrix()
            pose[elbow], pose[wrist] = pose[elbow] @ turn.T, turn @ pose[wrist]
            turned += angle != 0
    assert turned > 100
    assert_allclose(share_twists(SKELETON, rotations), expected, atol=ROUND_OFF)
    assert_allclose(share_twists(SKELETON, rotations[7]), expected[7], atol=ROUND_OFF)


@pytest.mark.parametrize(
    ("elbow", "wrist", "kept"),
    [(90, 0, (60, 30)), (120, 0, (60, 60)), (0, 120, (60, 60)), (0, -120, (-60, -60)), (120, -120, (0, 0))],
)
def test_twists_of_both_ends_after_sharing(elbow: float, wrist: float, kept: tuple[float, float]) -> None:
    shared = share_twists(SKELETON, _pose(left_elbow=(elbow, 0), left_wrist=(wrist, 0)))
    axis, _ = _axes("left")
    for joint, degrees in zip(("left_elbow", "left_wrist"), kept):
        expected = axis_angle_to_matrix(np.radians(degrees) * axis)
        assert_allclose(shared[NAMES.index(joint)], expected, atol=1e-9)


def test_what_is_twisted_less_stays_as_it_is() -> None:
    pose = _pose(left_elbow=(59.9, 100), right_elbow=(-59.9, 0), left_wrist=(-59.9, 30))
    assert share_twists(SKELETON, pose) is pose


def test_no_joint_moves_and_only_forearms_turn() -> None:
    pose = axis_angle_to_matrix(np.random.default_rng(1).normal(0, 0.3, (len(NAMES), 3)))
    pose[NAMES.index("right_wrist")] = _pose(right_wrist=(110, 20))[NAMES.index("right_wrist")]
    before, after = (SKELETON.joint_transforms(r, np.zeros(3)) for r in (pose, share_twists(SKELETON, pose)))
    assert_allclose(after[:, :3, 3], before[:, :3, 3], atol=ROUND_OFF)
    turned = np.abs(after - before).max((1, 2)) > 0.1
    assert [name for name, turns in zip(NAMES, turned) if turns] == ["right_elbow"]


@pytest.mark.parametrize("centre", [(60, 0), (180, 0), (120, 120), (120, 180), (0, 180), (180, 90)])
def test_nothing_jumps(centre: tuple[float, float]) -> None:
    rng, step = np.random.default_rng(2), 1e-5
    pose = _pose(left_elbow=centre)
    near = pose @ axis_angle_to_matrix(rng.normal(0, 1e-4, (4000, len(NAMES), 3)))
    further, elbow = near.copy(), NAMES.index("left_elbow")
    further[:, elbow] @= axis_angle_to_matrix(rng.normal(0, step, (4000, 3)))
    given, made = further - near, share_twists(SKELETON, further) - share_twists(SKELETON, near)
    steepness = np.sqrt((made**2).sum((1, 2, 3)) / (given**2).sum((1, 2, 3)))
    assert steepness.max() < STEEPEST


def test_the_player_and_the_trainer_skin_by_the_same_bones(tmp_path) -> None:
    avatar = Avatar.load(ROOT / "assets/avatar.onnx")
    rotations = np.tile(_pose(left_wrist=(100, 10), right_elbow=(-90, 40)), (3, 1, 1, 1))
    motion = Motion(rotations, np.full((3, 3), 0.1), 30.0, avatar.skeleton.names)
    played = avatar.encode(motion, 0.05).in_world().bones
    trained = pose_input(motion, avatar.skeleton, 0.05, ModelConfig()).bones.numpy()
    assert_allclose(played, trained, atol=1e-6)
    assert_allclose(trained, skinning_bones(avatar.skeleton, rotations[0], [0.1] * 3), atol=1e-6)
    assert np.abs(trained - bone_transforms(avatar.skeleton, rotations[0], [0.1] * 3)).max() > 0.1


_PAGE = """
import { readFileSync } from "node:fs";
const { shareTwists } = await import(process.argv[1] + "/posing/forearm.js");
const { skeleton, poses } = JSON.parse(readFileSync(0));
const shared = poses.map((pose) => Float64Array.from(pose));
for (const pose of shared) shareTwists(skeleton, pose);
console.log(JSON.stringify(shared.map((pose) => [...pose])));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
def test_the_page_shares_them_too() -> None:
    rotations = axis_angle_to_matrix(np.random.default_rng(3).normal(0, 1.3, (40, len(NAMES), 3)))
    parents, rest = SKELETON.parents.tolist(), SKELETON.rest_joints.reshape(-1).tolist()
    skeleton = {"names": NAMES, "parents": parents, "rest": rest}
    given = json.dumps({"skeleton": skeleton, "poses": rotations.reshape(40, -1).tolist()})
    source = (ROOT / "viewer/web/src").as_uri()
    command = ["node", "--input-type=module", "--eval", _PAGE, source]
    made = json.loads(subprocess.run(command, check=True, input=given.encode(), capture_output=True, timeout=60).stdout)
    assert_allclose(np.reshape(made, rotations.shape), share_twists(SKELETON, rotations), atol=ROUND_OFF)
