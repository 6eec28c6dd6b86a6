"""Joints by other programs' names and by a user's table."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.joint_names import load_joint_map, match_joints
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.smpl import SMPL_NAMES
from support.known_motion import DOUBLE, FRAMES, MATRICES, METRES, PELVIS, POSES, SKELETON, write_npz
from support.known_skeletons import NAMINGS, assert_same_poses, write_bvh


@pytest.mark.parametrize("collars", [True, False])
def test_a_shoulder_is_the_upper_arms_where_the_elbow_is_called_so(collars):
    """ "LeftShoulder" is a collar bone beside a "LeftArm", and no joint of the trunk is left out."""
    names = ["Hips", "Chest", "Neck", "Head"]
    for side in ("Left", "Right"):
        parts = (*(("Collar",) if collars else ()), "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle")
        names += [side + part for part in parts]
    matched = match_joints(names, SMPL_NAMES)
    assert len(matched) == len(names)
    assert names[matched["left_shoulder"]] == "LeftShoulder" and names[matched["spine1"]] == "Chest"


@pytest.mark.parametrize("naming", NAMINGS)
def test_every_naming_of_bvh_is_the_same_motion(tmp_path, naming):
    motion = load_motion(write_bvh(tmp_path / "a.bvh", NAMINGS[naming], spread={}), SKELETON)
    assert motion.fps == 120
    assert_same_poses(motion.rotations, MATRICES)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)


@pytest.mark.parametrize("form", ["toml", "json"])
def test_names_we_do_not_know_come_from_the_users_table(tmp_path, form):
    strange = {name: f"B{joint:02d}" for joint, name in enumerate(SMPL_NAMES)}
    file = write_bvh(tmp_path / "a.bvh", strange, spread={})
    with pytest.raises(InputError, match="--joint-map"):
        load_motion(file, SKELETON)
    table = tmp_path / f"names.{form}"
    if form == "toml":
        table.write_text("\n".join(f'{ours} = "{theirs}"' for ours, theirs in strange.items()))
    else:
        table.write_text("{" + ", ".join(f'"{a}": ["x", "{b}"]' for a, b in strange.items()) + "}")
    motion = load_motion(file, SKELETON, joint_map=table)
    assert_same_poses(motion.rotations, MATRICES)


def test_a_table_may_have_sides_and_only_what_is_missing(tmp_path):
    (tmp_path / "t.toml").write_text('[mine]\nsides = ["Li", "Re"]\n"*_hand" = "*Finger"\n')
    table = load_joint_map(tmp_path / "t.toml")
    assert table == {"left_hand": ("LiFinger",), "right_hand": ("ReFinger",)}
    theirs = [*NAMINGS["mixamo"].values(), "ReFinger", "LiFinger"]
    matched = match_joints(theirs, SMPL_NAMES, table)
    assert theirs[matched["left_hand"]] == "LiFinger" and theirs[matched["left_ankle"]] == "mixamorig:LeftFoot"
    for wrong, word in (
        ('tail = "x"', "tail"),
        ('head = "x"', "x"),
        ("head = 3", "head"),
        ("[", "TOML"),
        ("", "at least"),
    ):
        (tmp_path / "w.toml").write_text(wrong)
        with pytest.raises(InputError, match=word):
            match_joints(theirs, SMPL_NAMES, load_joint_map(tmp_path / "w.toml"))


@pytest.mark.parametrize(("line", "said"), [('tail = "Hips"', "avatar"), ('head = "Snout"', "motion")])
def test_a_mistake_in_a_joint_map_is_blamed_on_it(tmp_path, line, said):
    """Whether the motion has a skeleton of its own or names its columns."""
    table = tmp_path / "t.toml"
    table.write_text(line)
    named = write_npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=SMPL_NAMES)
    for file in (write_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"]), named):
        with pytest.raises(InputError, match=f"t.toml: joint map: expected joints of the {said}"):
            load_motion(file, SKELETON, joint_map=table)


def test_a_joint_map_renames_named_arrays_too(tmp_path):
    names = [f"B{joint}" for joint in range(24)]
    file = write_npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=names)
    (tmp_path / "t.toml").write_text("\n".join(f'{ours} = "B{k}"' for k, ours in enumerate(SMPL_NAMES)))
    motion = load_motion(file, SKELETON, joint_map=tmp_path / "t.toml")
    assert_allclose(motion.rotations, MATRICES, atol=DOUBLE)


def test_a_joint_map_counts_where_names_are_known_too(tmp_path):
    """spine3 shall be what the file calls spine1; what is called spine3 there is nobody's."""
    file = write_npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=SMPL_NAMES)
    (tmp_path / "t.toml").write_text('spine3 = "spine1"')
    motion = load_motion(file, SKELETON, joint_map=tmp_path / "t.toml")
    spine1, spine3 = SMPL_NAMES.index("spine1"), SMPL_NAMES.index("spine3")
    assert_allclose(motion.rotations[:, spine3], MATRICES[:, spine1], atol=DOUBLE)
    assert_allclose(motion.rotations[:, spine1], np.broadcast_to(np.eye(3), (FRAMES, 3, 3)), atol=DOUBLE)
    assert any("stay at rest: spine1" in note for note in motion.notes)


def test_a_mark_of_utf_8_before_a_text_is_no_part_of_it(tmp_path):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
    file.write_text("\ufeff" + file.read_text("utf-8"), "utf-8")
    table = tmp_path / "t.json"
    table.write_text("\ufeff" + json.dumps({"spine1": NAMINGS["smpl"]["spine1"]}), "utf-8")
    assert load_motion(file, SKELETON, joint_map=table).frame_count == FRAMES
