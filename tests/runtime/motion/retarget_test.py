"""Motions of other skeletons on ours: axes, floor, facing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.joint_names import match_joints
from rnd_runtime.motion.limbs import Bones
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.readers.bvh import read_bvh
from rnd_runtime.motion.retarget import Retargeted, retarget
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from support.known_motion import FRAMES, MATRICES, METRES, PELVIS, SKELETON, TEXT, Z_UP
from support.known_skeletons import NAMINGS, assert_same_poses, write_bvh
from support.paths import SHARED
from support.zero_poses import random_rotations

SHARED_DATA = SHARED / "data" / "motion"


def test_an_upright_axis_that_the_user_gives_counts(tmp_path):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], axes=Z_UP)
    as_said = load_motion(file, SKELETON, up="z")
    assert_same_poses(as_said.rotations, MATRICES)
    lying = load_motion(file, SKELETON, up="y")
    assert abs(lying.rotations[0, 0] @ [0, 1, 0])[1] < 0.5


def test_feet_come_down_to_the_floor(tmp_path):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
    lifted = file.with_name("b.bvh")
    text = file.read_text().splitlines()
    start = next(k for k, line in enumerate(text) if line.startswith("Frame Time")) + 1
    for k in range(start, len(text)):
        x, y, z, *rest = text[k].split()
        text[k] = " ".join([x, str(float(y) + 3), z, *rest])
    lifted.write_text("\n".join(text))
    motions = [load_motion(one, SKELETON) for one in (file, lifted)]
    assert_allclose(motions[0].translations, motions[1].translations, atol=METRES)
    feet = [SMPL_NAMES.index(name) for name in ("left_ankle", "right_ankle", "left_foot", "right_foot")]
    joints = SKELETON.joint_transforms(motions[0].rotations, motions[0].translations)[:, feet, 1, 3]
    lowest = (joints - SKELETON.rest_joints[feet, 1]).min(1)
    assert -0.01 < lowest.min() < 0.01 and lowest.max() < 0.2


@pytest.mark.parametrize("down", [0.0, 1.15])
def test_feet_come_down_to_the_floor_wherever_the_template_rests(tmp_path, down):
    """A template about SMPL's origin plays a recording at the height of one that stands on its feet."""
    skeleton = replace(SKELETON, rest_joints=SKELETON.rest_joints - [0, down, 0])
    motion = load_motion(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]), skeleton)
    feet = [SMPL_NAMES.index(f"{side}_foot") for side in ("left", "right")]
    lowest = skeleton.joint_transforms(motion.rotations, motion.translations)[:, feet, 1, 3].min()
    assert lowest == pytest.approx(SKELETON.rest_joints[feet, 1].min(), abs=0.02)


def _placed(file: Path, height: float) -> Path:
    """The file with its hips at ``height`` along Y and in the middle."""
    head, mark, frames = file.read_text().partition("Frame Time: 0.0083333\n")
    lines = [" ".join(["0", f"{height}", "0", *line.split()[3:]]) for line in frames.splitlines()]
    file.write_text(head + mark + "\n".join(lines) + "\n")
    return file


def test_who_lies_or_crawls_is_not_stood_upright(tmp_path):
    """Hips at 0.35 m, trunk level: Y stays up, and a note says so."""
    level = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    file = _placed(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], facing=level), 0.35)
    told, as_said = load_motion(file, SKELETON), load_motion(file, SKELETON, up="y")
    assert_allclose(told.rotations, as_said.rotations, atol=TEXT)
    assert abs(told.rotations[:, 0, 1, 1].mean()) < 0.3
    assert "the trunk lies along z, and y stays up, as in its layout; --motion-up z overrules" in told.notes
    assert not any("--motion-up" in note for note in as_said.notes)


def test_a_trunk_that_stands_along_another_axis_makes_it_up_with_a_note(tmp_path):
    """A Z-up world on a zero pose that stands along Y: hips a leg above the floor."""
    level = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    motion = load_motion(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], facing=level), SKELETON)
    assert motion.rotations[:, 0, 1, 1].mean() > 0.9
    assert "z is taken for up, as the trunk stands along it; --motion-up y overrules" in motion.notes


def test_recorded_joints_that_nothing_follows_are_told(tmp_path):
    """Not those that carry others, as the second joint of this spine does."""
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
    assert load_motion(file, SKELETON).left_out == ()  # hands stand still there
    few = [k for k, name in enumerate(SMPL_NAMES) if name not in ("spine2", "head", "left_foot")]
    parents = [-1, 0, 0, 0, 1, 2, 4, 5, 3, 7, 8, 8, 8, 11, 12, 13, 14, 15, 16, 17, 18]
    skeleton = Skeleton(tuple(SMPL_NAMES[k] for k in few), parents, SKELETON.rest_joints[few])
    assert load_motion(file, skeleton).left_out == ("left_foot", "head")


def test_a_recording_is_turned_to_the_front_and_a_reference_pose_left_out(tmp_path):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=True)
    motion = load_motion(file, SKELETON)
    assert motion.frame_count == FRAMES and any("T-pose" in note for note in motion.notes)
    assert_same_poses(motion.rotations, MATRICES)
    behind = Rotation.from_euler("y", 170, degrees=True).as_matrix()  # zero pose and world alike
    again = load_motion(write_bvh(tmp_path / "b.bvh", NAMINGS["smpl"], axes=behind), SKELETON)
    forward = again.rotations[0, 0] @ [0, 0, 1]
    assert np.degrees(np.arccos(np.clip(forward @ (MATRICES[0, 0] @ [0, 0, 1]), -1, 1))) < 45.1
    assert_allclose(again.rotations[:, 1:], motion.rotations[:, 1:], atol=TEXT)


def test_the_motion_begins_facing_the_front_whatever_a_reference_pose_faces(tmp_path):
    facing = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    for t_pose in (False, True):
        motion = load_motion(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=t_pose, facing=facing), SKELETON)
        assert motion.frame_count == FRAMES and any("rotated by -90°" in note for note in motion.notes)
        assert_same_poses(motion.rotations, MATRICES)
        assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)


def test_what_retargeting_makes_no_numbers_of_is_refused(tmp_path, monkeypatch):
    def torn(*arguments: object) -> Retargeted:
        moved = retarget(*arguments)
        moved.rotations[3, 0] = np.nan
        return moved

    monkeypatch.setattr("rnd_runtime.motion.motion.retarget", torn)
    with pytest.raises(InputError, match=r"a\.bvh: frame 3: motion: expected finite numbers"):
        load_motion(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]), SKELETON)


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here; all else here is self-made")
@pytest.mark.parametrize("name", ["cmu_12_03.bvh", "dab.bvh", "jumping.bvh"])
def test_real_recordings_do_not_depend_on_their_zero_pose(name):
    """Every sixth frame of it, as it is and with random axes of all bones."""
    tree = read_bvh(SHARED_DATA / "bvh" / name)
    tree = replace(tree, rotations=tree.rotations[::6], root_positions=tree.root_positions[::6], fps=tree.fps / 6)
    matched = match_joints(tree.names, SMPL_NAMES, bones=Bones(tree.parents, tree.offsets))
    axes = random_rotations(np.random.default_rng(1), len(tree.names))
    world = tree.global_rotations() @ np.swapaxes(axes, -1, -2)
    local, offsets = world.copy(), tree.offsets.copy()
    for joint, parent in enumerate(tree.parents[1:], 1):
        local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
        offsets[joint] = axes[parent] @ offsets[joint]
    plain = retarget(tree, SKELETON, matched)
    odd = retarget(replace(tree, rotations=local, offsets=offsets), SKELETON, matched)
    assert_same_poses(odd.rotations, plain.rotations)
    assert_allclose(odd.translations, plain.translations, atol=1e-3)
    assert {note for note in odd.notes if "taken for up" not in note} == set(plain.notes)


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here; all else here is self-made")
@pytest.mark.parametrize("name", ["cmu_12_03.bvh", "dab.bvh", "wave_hello.bvh", "jumping.bvh", "02_01.amc"])
def test_real_recordings_stand_bend_and_face_forward(name):
    motion = load_motion(SHARED_DATA / "bvh" / name, SKELETON)
    posed = SKELETON.joint_transforms(motion.rotations, motion.translations)
    joints = posed[..., :3, 3]
    place = {joint: joints[:, k] for k, joint in enumerate(SMPL_NAMES)}
    above = place["head"][:, 1] - place["pelvis"][:, 1]
    assert above.min() > 0 and np.median(above) > 0.5  # jumping crouches before it jumps
    assert posed[0, 0, 2, 2] > np.cos(np.radians(46))  # within an eighth of a turn of +Z, for quarters were turned
    feet = [SMPL_NAMES.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("ankle", "foot")]
    lowest = (joints[:, feet, 1] - SKELETON.rest_joints[feet, 1]).min(1)
    assert lowest.min() > -0.01 and np.median(lowest) < 0.05
    for side in ("left", "right"):  # a knee takes the shin backwards
        hip, knee, ankle = (place[f"{side}_{joint}"] for joint in ("hip", "knee", "ankle"))
        thigh, shin = (bone / np.linalg.norm(bone, axis=1, keepdims=True) for bone in (knee - hip, ankle - knee))
        forward = posed[:, SMPL_NAMES.index(f"{side}_hip"), :3, 2]
        bend = ((shin - thigh) * forward).sum(-1)
        assert bend.max() < 0.15
