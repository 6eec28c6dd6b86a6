"""Joints by other programs' names and by a user's table."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.joint_names import load_joint_map, match_joints
from rnd_runtime.motion.limbs import Bones
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from support.known_motion import DOUBLE, FRAMES, MATRICES, METRES, PELVIS, POSES, SKELETON, write_npz
from support.known_skeletons import NAMINGS, assert_same_poses, write_bvh
from support.paths import CASES


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


_LEGS = {"*_hip": "UpLeg", "*_knee": "Leg", "*_ankle": "Foot", "*_foot": "ToeBase"}
_ARMS = {"*_collar": "Shoulder", "*_shoulder": "Arm", "*_elbow": "ForeArm", "*_wrist": "Hand"}
_TRUNK = {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"}
_SMPL = {f"*_{joint}": joint.title() for joint in ("collar", "shoulder", "elbow", "wrist", "hand", "hip", "knee")}
_SMPL |= {"*_ankle": "Ankle", "*_foot": "Foot", "pelvis": "Pelvis"} | {f"spine{k}": f"Spine{k}" for k in (1, 2, 3)}
_LOW = {"*_elbow": "LowerArm", "*_shoulder": "UpperArm", "*_hip": "UpperLeg", "*_knee": "LowerLeg"}
# Names of each joint, how a side is written around them, and what the two sides are called
SPELLINGS = {
    "LAFAN1": (_TRUNK | _ARMS | _LEGS | {"*_foot": "Toe"}, "{side}{name}", ("Left", "Right")),
    "underscore": (_TRUNK | _ARMS | _LEGS, "mixamorig_{side}{name}", ("Left", "Right")),
    "number": (_TRUNK | _ARMS | _LEGS, "mixamorig1{side}{name}", ("Left", "Right")),
    "number of each": (_TRUNK | _ARMS | _LEGS, "mixamorig:{side}{name}_0{joint}", ("Left", "Right")),
    "path": (_TRUNK | _ARMS | _LEGS, "Armature|mixamorig:{side}{name}", ("Left", "Right")),
    "suffix": ({k: v.lower() for k, v in (_TRUNK | _ARMS | _LEGS).items()}, "{side}_{name}_JNT", ("l", "r")),
    "side last": (_TRUNK | _ARMS | _LEGS, "{name}.{side}", ("L", "R")),
    "SMPL of Unity": (_SMPL | {"neck": "Neck", "head": "Head"}, "m_avg_{side}_{name}", ("L", "R")),
    "Bandai-Namco": (
        {"pelvis": "Hips", "spine1": "Spine", "spine3": "Chest", "neck": "Neck", "head": "Head"}
        | _ARMS
        | _LEGS
        | _LOW
        | {"*_foot": "Toes"},
        "{name}_{side}",
        ("L", "R"),
    ),
    "VRM": (
        _TRUNK | {"spine2": "Chest", "spine3": "UpperChest"} | _ARMS | _LEGS | _LOW,
        "J_Bip_{side}_{name}",
        ("L", "R"),
    ),
    "Genesis 9": (
        {"pelvis": "hip", "spine1": "spine1", "spine2": "spine2", "spine3": "spine4", "neck": "neck1", "head": "head"}
        | {"*_collar": "shoulder", "*_shoulder": "upperarm", "*_elbow": "forearm", "*_wrist": "hand"}
        | {"*_hip": "thigh", "*_knee": "shin", "*_ankle": "foot", "*_foot": "toes"},
        "{side}_{name}",
        ("l", "r"),
    ),
    "MocapNET": (
        {"pelvis": "hip", "spine1": "abdomen", "spine3": "chest", "neck": "neck", "head": "head"}
        | {"*_collar": "collar", "*_shoulder": "shoulder", "*_elbow": "elbow", "*_wrist": "hand"}
        | {"*_hip": "hip", "*_knee": "knee", "*_ankle": "foot", "*_foot": "toe"},
        "{side}{name}",
        ("l", "r"),
    ),
}
_TREE = Bones(SMPL_PARENTS, SKELETON.rest_joints - SKELETON.rest_joints[[max(parent, 0) for parent in SMPL_PARENTS]])


def _spelled(names: dict[str, str], form: str, sides: tuple[str, str]) -> dict[str, str]:
    """Their names by ours; a joint in the middle has no side, or "C" where a separate letter is usual."""
    middle = "C" if form.startswith("J_Bip") else ""
    spelled = {}
    for ours, name in names.items():
        for side, theirs in zip(("left", "right"), sides) if "*" in ours else (("", middle),):
            full = (
                form.format(side=theirs, name=name, joint="{joint}")
                if theirs
                else form.replace("{side}_", "")
                .replace("_{side}", "")
                .replace(".{side}", "")
                .replace("{side}", "")
                .format(name=name, joint="{joint}")
            )
            spelled[ours.replace("*", side)] = full
    return spelled


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_joints_are_found_however_they_are_spelled(spelling):
    """None is missed or another's; a joint of the spine without a known name is found by its place."""
    spelled = _spelled(*SPELLINGS[spelling])
    spelled = {name: theirs.format(joint=SMPL_NAMES.index(name)) for name, theirs in spelled.items()}
    theirs = [spelled.get(name, f"extra{joint}") for joint, name in enumerate(SMPL_NAMES)]
    matched = match_joints(theirs, SMPL_NAMES, bones=_TREE)
    known = spelled if "spine2" in spelled else spelled | {"spine2": "extra6"}
    assert {name: theirs[index] for name, index in matched.items()} == known


def test_the_tree_decides_whether_a_leg_is_a_thigh():
    """ "LeftLeg" is a shin below a "LeftUpLeg", and a thigh above a "LeftShin", though as many names fit either."""
    for legs in (_LEGS, {**_LEGS, "*_hip": "Leg", "*_knee": "Shin"}):
        spelled = _spelled(_TRUNK | _ARMS | legs, "{side}{name}", ("Left", "Right"))
        theirs = [spelled.get(name, f"extra{joint}") for joint, name in enumerate(SMPL_NAMES)]
        matched = match_joints(theirs, SMPL_NAMES, bones=_TREE)
        assert {name: theirs[index] for name, index in matched.items()} == spelled


@pytest.mark.parametrize(
    "unknown",
    [
        {"*_elbow": "Arm1"},  # BEAT's
        {"*_knee": "LoLeg"},
        {"*_collar": "Thorax"},
        {"neck": "NeckTwist01"},  # Character Creator's
        {"pelvis": "SpineBase", "spine2": "SpineMid"},  # Kinect's
        {"*_elbow": "Arm1", "neck": "b_neck0", "*_collar": "Thorax", "pelvis": "Base", "spine3": "Ribs"},
    ],
    ids=lambda unknown: ", ".join(unknown),
)
def test_joints_between_known_ones_are_found_by_their_place(unknown):
    spelled = _spelled(_TRUNK | _ARMS | _LEGS | unknown, "{side}{name}", ("Left", "Right"))
    theirs = [spelled.get(name, f"extra{joint}") for joint, name in enumerate(SMPL_NAMES)]
    matched = match_joints(theirs, SMPL_NAMES, bones=_TREE)
    assert {name: theirs[index] for name, index in matched.items()} == spelled


def test_the_chest_carries_the_arms_whatever_lies_between_it_and_the_neck():
    """A joint between chest and neck is none of the three of the spine."""
    names = ["Hips", "Spine", "Chest", "neckDummy", "Neck", "Head"]
    parents = [-1, 0, 1, 2, 3, 4]
    for side in ("Left", "Right"):
        for above, parts in ((2, ("Collar", "Shoulder", "Elbow", "Wrist")), (0, ("Hip", "Knee", "Ankle"))):
            for part in parts:
                parents.append(above)
                names.append(side + part)
                above = len(names) - 1
    matched = match_joints(names, SMPL_NAMES, bones=Bones(parents, np.full((len(names), 3), 0.1)))
    assert {names[matched[joint]]: joint for joint in ("spine1", "spine3", "neck")} == {
        "Spine": "spine1",
        "Chest": "spine3",
        "Neck": "neck",
    }
    assert "spine2" not in matched


@pytest.mark.parametrize("file", sorted((CASES / "bvh_prefixed_names").glob("*.bvh")), ids=lambda file: file.stem)
def test_a_prefix_that_all_joints_share_says_nothing(file):
    plain = load_motion(CASES / "bvh_prefixed_names" / "mixamorig_colon.bvh", SKELETON)
    motion = load_motion(file, SKELETON)
    assert_allclose(motion.rotations, plain.rotations, atol=DOUBLE)
    assert motion.notes == plain.notes


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
