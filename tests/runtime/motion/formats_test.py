"""Formats of other programs that are retargeted or fitted: a walk in each comes back."""

import json
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.formats.vectors import humanml_positions
from rnd_runtime.motion.motion import load_motion
from support.foreign_motion import (
    JOINTS,
    MATRICES,
    PELVIS,
    humanml_numbers,
    sam3d_people,
    write_gemx,
    write_glb,
    write_kimodo,
    write_sam3d,
    write_somax,
)
from support.known_motion import SKELETON, write_npz, write_pickle
from support.known_skeletons import assert_same_poses

LIMBS = ("shoulder", "elbow", "hip", "knee")
POINTS, ROLLS = 2.0, 6.0  # degrees: of limbs' directions, of their rotations
HANDS = 20.0  # of wrists, whose fingers' joints other rigs have elsewhere
POSITIONS_ALONE = 4.0


def _directions(rotations: np.ndarray) -> np.ndarray:
    """Of the limbs' bones [F, 8, 3]."""
    joints = SKELETON.joint_transforms(rotations, np.zeros(3))[..., :3, 3]
    below = {name: k for k, name in enumerate(SKELETON.names)}
    pairs = [
        (below[f"{side}_{a}"], below[f"{side}_{b}"])
        for side in ("left", "right")
        for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
    ]
    bones = np.stack([joints[:, b] - joints[:, a] for a, b in pairs], 1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def _worst_direction(motion) -> float:
    cosines = (_directions(motion.rotations) * _directions(MATRICES)).sum(-1)
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


def _worst_rotation(motion, parts=LIMBS) -> float:
    """Of the limbs' joints in the world, degrees."""
    worst = 0.0
    given = SKELETON.joint_transforms(motion.rotations, np.zeros(3))[..., :3, :3]
    known = SKELETON.joint_transforms(MATRICES, np.zeros(3))[..., :3, :3]
    for k, name in enumerate(SKELETON.names):
        if name.endswith(parts):
            between = Rotation.from_matrix(given[:, k].swapaxes(-1, -2) @ known[:, k])
            worst = max(worst, float(np.degrees(between.magnitude()).max()))
    return worst


def _path_off(motion) -> float:
    """Largest distance in m of the pelvis' path to the known one, but for its scale, floor and beginning."""
    path, known = motion.translations - motion.translations[0], PELVIS - PELVIS[0]
    scale = (path * known).sum() / (known * known).sum()
    assert 0.8 < scale < 1.25
    return float(np.linalg.norm(path - scale * known, axis=1).max())


MIXAMO = [
    f"mixamorig:{name}"
    for name in (
        *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot"),
        *("Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm"),
        *("RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand", "LeftHandIndex1", "RightHandIndex1"),
    )
]
BONES = [f"bone {k}" for k in range(24)]
VRM = (
    *("hips", "leftUpperLeg", "rightUpperLeg", "spine", "leftLowerLeg", "rightLowerLeg", "chest", "leftFoot"),
    *("rightFoot", "upperChest", "leftToes", "rightToes", "neck", "leftShoulder", "rightShoulder", "head"),
    *("leftUpperArm", "rightUpperArm", "leftLowerArm", "rightLowerArm", "leftHand", "rightHand"),
)
VRM_0 = {"VRM": {"humanoid": {"humanBones": [{"bone": bone, "node": k + 1} for k, bone in enumerate(VRM)]}}}
VRM_1 = {"VRMC_vrm": {"humanoid": {"humanBones": {bone: {"node": k + 1} for k, bone in enumerate(VRM)}}}}
VRMA = {"VRMC_vrm_animation": VRM_1["VRMC_vrm"]}

FORMATS = {
    "Kimodo": (write_kimodo, 30),
    "Kimodo without its joints": (lambda f: write_kimodo(f, joints=False), 30),
    "GEM-X": (write_gemx, 30),
    "SOMA-X": (write_somax, 30),
    **{f"SAM 3D Body, {form}": (lambda f, form=form: write_sam3d(f, form), 30) for form in ("list", "dict", "folder")},
    **{f"SAM 3D Body, {form}": (lambda f, form=form: write_sam3d(f, form), 30) for form in ("npz", "json", "flipped")},
    "GLB of Blender": (lambda f: write_glb(f, MIXAMO), 25),
    "GLB with splines": (lambda f: write_glb(f, MIXAMO, method="CUBICSPLINE", scale=1.0), 25),
    "GLB with steps": (lambda f: write_glb(f, MIXAMO, method="STEP"), 25),
    "VRM 0": (lambda f: write_glb(f, BONES, VRM_0, "a.vrm"), 25),
    "VRM 1": (lambda f: write_glb(f, BONES, VRM_1, "a.vrm"), 25),
    "VRMA": (lambda f: write_glb(f, BONES, VRMA, "a.vrma"), 25),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_recorded_skeleton_gives_the_known_motion(tmp_path, name):
    write, fps = FORMATS[name]
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == fps
    assert _worst_direction(motion) < POINTS
    assert _worst_rotation(motion) < ROLLS
    assert _worst_rotation(motion, ("_wrist",)) < HANDS
    assert _path_off(motion) < 0.03


POSITIONS = {
    "joint positions": lambda f: _save(f, JOINTS[:, :22]),
    "of 24 joints": lambda f: _save(f, JOINTS),
    "in millimetres": lambda f: _save(f, 1000 * JOINTS[None, :, :22]),
    "MDM": lambda f: write_pickle(
        f / "results.pkl",
        {"motion": np.stack([JOINTS[:, :22].transpose(1, 2, 0)] * 2), "lengths": np.array([len(JOINTS)] * 2)},
    ),
    "HumanML3D": lambda f: _save(f, humanml_numbers(JOINTS[:, :22])),
    "HumanML3D, several": lambda f: _save(f, np.stack([humanml_numbers(JOINTS[:, :22])] * 3)),
    "time last": lambda f: _save(f, JOINTS[:, :22].transpose(1, 2, 0)),
    "several, time last": lambda f: _save(f, np.stack([JOINTS.transpose(1, 2, 0)] * 2)),
    ".npz": lambda f: write_npz(f / "a.npz", joints=JOINTS[:, :22]),
    ".npz of HumanML3D": lambda f: write_npz(f / "a.npz", motion=humanml_numbers(JOINTS[:, :22])),
    "dict": lambda f: write_pickle(f / "a.pkl", {"joints3d": JOINTS, "text": "walks"}),
}


def _save(folder, array):
    np.save(folder / "a.npy", array)
    return folder / "a.npy"


@pytest.mark.parametrize("name", POSITIONS)
def test_poses_are_fitted_to_positions(tmp_path, name):
    motion = load_motion(POSITIONS[name](tmp_path), SKELETON)
    assert motion.fps == 20
    notes = " ".join(motion.notes)
    assert "without rotations" in notes and "20 frames per second assumed" in notes
    assert ("the first is taken" in notes) == (name in ("MDM", "HumanML3D, several", "several, time last"))
    assert ("millimetres" in notes) == (name == "in millimetres")
    assert _worst_direction(motion) < POSITIONS_ALONE
    assert _path_off(motion) < 0.03


def test_named_positions_have_their_frame_rate(tmp_path):
    motion = load_motion(write_npz(tmp_path / "a.npz", joints=JOINTS, fps=25.0), SKELETON)
    assert motion.fps == 25 and not any("frame rate" in note for note in motion.notes)


def test_of_several_kimodo_motions_the_first_is_taken(tmp_path):
    plain = load_motion(file := write_kimodo(tmp_path), SKELETON)
    with np.load(file) as members:
        both = {name: np.stack([array, array[::-1]]) for name, array in members.items() if array.ndim > 1}
    motion = load_motion(write_npz(tmp_path / "b.npz", **both), SKELETON)
    assert_allclose(motion.rotations, plain.rotations, atol=1e-9)
    assert "2 motions in the file: the first is taken" in motion.notes


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([[{"pred_cam_t": JOINTS[0, 0], "shape_params": 3}]], "a list of a list of pred_cam_t, shape_params"),
        ({"a.jpg": {"pred_cam_t": JOINTS[0, 0]}, "b.jpg": {}}, "a.jpg, b.jpg: pred_cam_t"),
        ({}, "no keys"),
    ],
    ids=["list", "dict", "empty"],
)
def test_what_is_no_motion_is_described(tmp_path, content, said):
    with pytest.raises(InputError, match=rf"a\.pkl: motion: expected a dict of arrays, got {said}$"):
        load_motion(write_pickle(tmp_path / "a.pkl", content), SKELETON)


def test_humanml3ds_numbers_are_positions():
    recovered = humanml_positions(humanml_numbers(JOINTS[:, :22]))
    begin = JOINTS[0, 0] * [1, 0, 1]
    assert_allclose(recovered, JOINTS[:, :22] - begin, atol=1e-9)


def test_normalised_numbers_are_refused_with_the_way(tmp_path):
    numbers = humanml_numbers(JOINTS[:, :22])
    with pytest.raises(InputError, match=r"a\.npy: HumanML3D's 263 numbers: .* Std.npy and Mean.npy first"):
        load_motion(_save(tmp_path, (numbers - numbers.mean(0)) / (numbers.std(0) + 1)), SKELETON)


def _document(path):
    """JSON of a .glb, and a writer of it with another."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    binary = content[20 + size :]

    def write(document) -> None:
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + binary
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

    return json.loads(content[20 : 20 + size]), write


def _circle(document):
    document["nodes"][5]["children"] = [0]


def _two_parents(document):
    document["nodes"][24]["children"] = [2]


def _sparse(document):
    del document["accessors"][1]["bufferView"]


def _compressed(document):
    document["bufferViews"][1]["extensions"] = {"EXT_meshopt_compression": {}}


def _outside(document):
    document["buffers"][0]["uri"] = "../../secret.bin"


def _long(document):
    document["accessors"][1]["count"] = 10**9


def _elsewhere(document):
    document["animations"][0]["channels"][0]["target"]["node"] = 99


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_circle, "got a circle"),
        (_two_parents, "one parent each"),
        (_sparse, "expected a dense one"),
        (_compressed, "expected an uncompressed one, got EXT_meshopt_compression"),
        (_outside, "expected a file beside it"),
        (_long, "got an end before"),
        (_elsewhere, "expected one of 25 nodes, got 99"),
        (lambda document: document.pop("accessors"), "expected a valid one, got KeyError"),
        (lambda document: document.pop("asset"), "expected a glTF document"),
        (lambda document: document["nodes"][1].update(rotation=[0, 0, 0]), "rotation, translation and scale"),
    ],
)
def test_a_damaged_gltf_file_is_refused_in_one_line(tmp_path, change, words):
    path = write_glb(tmp_path, MIXAMO)
    document, write = _document(path)
    change(document)
    write(document)
    with pytest.raises(InputError) as caught:
        load_motion(path, SKELETON)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and words in line and "\n" not in line


def test_a_cut_gltf_file_is_refused(tmp_path):
    path = write_glb(tmp_path, MIXAMO)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"a\.glb: glTF file: expected \d+ bytes, got an end before"):
        load_motion(path, SKELETON)


def test_a_character_without_animation_names_the_way(tmp_path):
    path = write_glb(tmp_path, BONES, VRM_1, "a.vrm")
    document, write = _document(path)
    del document["animations"]
    write(document)
    with pytest.raises(InputError, match=r"got a glTF file without an animation \(.* its motions are \.vrma files\)"):
        load_motion(path, SKELETON)


def test_of_several_animations_the_first_of_a_body_is_taken_and_the_others_named(tmp_path):
    """Not a face's, an empty one or a single joint's."""
    path = write_glb(tmp_path, MIXAMO)
    plain = load_motion(path, SKELETON)
    document, write = _document(path)
    walk = document["animations"][0]
    face = {"channels": [{"sampler": 0, "target": {"node": 1, "path": "weights"}}], "samplers": walk["samplers"]}
    document["animations"].insert(0, face)
    document["animations"].append({"name": "jump", "channels": walk["channels"][:1], "samplers": walk["samplers"]})
    write(document)
    motion = load_motion(path, SKELETON)
    assert "of the file's animations walk is taken; left out: one without a name, jump" in motion.notes
    assert_allclose(motion.rotations, plain.rotations, atol=1e-9)


def test_a_mirrored_armature_is_mirrored_back(tmp_path):
    plain = load_motion(path := write_glb(tmp_path, MIXAMO), SKELETON)
    document, write = _document(path)
    document["nodes"][0]["scale"][0] *= -1
    write(document)
    motion = load_motion(path, SKELETON)
    assert_same_poses(motion.rotations, plain.rotations, degrees=0.1, limbs=0.1)
    assert "the skeleton's left is its right, as in left-handed axes: mirrored back" in motion.notes


def test_a_separate_buffer_may_have_a_space_in_its_name(tmp_path):
    plain = load_motion(path := write_glb(tmp_path, MIXAMO), SKELETON)
    document, _ = _document(path)
    (tmp_path / "a b.bin").write_bytes(path.read_bytes()[-document["buffers"][0]["byteLength"] :])
    document["buffers"][0]["uri"] = "a%20b.bin"
    (tmp_path / "a.gltf").write_text("\ufeff" + json.dumps(document), "utf-8")
    assert_allclose(load_motion(tmp_path / "a.gltf", SKELETON).rotations, plain.rotations, atol=1e-9)


def test_an_unknown_suffix_is_named(tmp_path):
    for name, got in (("a.htr", "a .htr file"), ("a", "a nameless file")):
        (tmp_path / name).write_text("[Header]")
        with pytest.raises(InputError, match=rf"motion: expected a \.bvh, \.glb, \.npz or .* motion, got {got}$"):
            load_motion(tmp_path / name, SKELETON)
    write_npz(tmp_path / "a.npz", joints=JOINTS).rename(tmp_path / "b")
    assert load_motion(tmp_path / "b", SKELETON).frame_count == len(JOINTS)


def test_sam3d_follows_one_person_through_gaps(tmp_path):
    """Another stands behind, first in every other image; images without people are filled in."""
    people = sam3d_people()
    people[5:5] = [[], None]
    motion = load_motion(write_pickle(tmp_path / "a.pkl", people), SKELETON)
    assert len(motion.rotations) == len(people)
    notes = " ".join(motion.notes)
    assert "2 frames without the person" in notes and "nearest to the camera is followed" in notes
    assert "the camera is taken to stand level" in notes and "shape and scale are ignored" in notes


def test_kimodos_robot_is_refused_by_name(tmp_path):
    rotations = np.tile(np.eye(3), (4, 34, 1, 1))
    np.savez(tmp_path / "a.npz", local_rot_mats=rotations, root_positions=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"expected 77 or 30 of SOMA \(34 are a Unitree G1's, a robot\), got 34"):
        load_motion(tmp_path / "a.npz", SKELETON)


def test_a_joint_map_names_more_joints_of_a_known_skeleton(tmp_path):
    (tmp_path / "map.toml").write_text('spine3 = "Spine2"\n')
    mapped = load_motion(write_kimodo(tmp_path), SKELETON, joint_map=tmp_path / "map.toml")
    assert not np.allclose(mapped.rotations, load_motion(tmp_path / "kimodo.npz", SKELETON).rotations)
    (tmp_path / "map.toml").write_text('spine3 = "Spine9"\n')
    with pytest.raises(InputError, match="joint map: expected joints of the avatar and of the motion, got Spine9"):
        load_motion(tmp_path / "kimodo.npz", SKELETON, joint_map=tmp_path / "map.toml")
