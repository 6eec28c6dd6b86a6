"""Motion files of every documented layout, sampling, and refusals that name file, field and frame."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, load_motion, save_motion
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS, SMPL_REST_ROOT, SMPLH_NAMES, SMPLX_NAMES, SMPLX_REST_ROOT
from support.paths import SHARED

SHARED_DATA = SHARED / "data"
ROUND_OFF = 1e-12
FRAMES = 5


def _skeleton() -> Skeleton:
    """SMPL's tree, standing on its feet: the root is a metre above the origin, unlike SMPL's own."""
    rest = np.random.default_rng(5).normal(size=(24, 3)) * 0.3
    rest[0] = [0.01, 1.0, 0.02]
    return smpl_skeleton(rest)


def _axis_angles(joints: int, frames: int = FRAMES, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(frames, joints, 3)) * 0.6


def _save(path: Path, **members: object) -> Path:
    np.savez(path, **{name: np.asarray(value) for name, value in members.items()})
    return path


def _flat(axis_angles: np.ndarray) -> np.ndarray:
    return axis_angles.reshape(len(axis_angles), -1)


TRANS = np.random.default_rng(9).normal(size=(FRAMES, 3)) * 0.05  # 5 m/s at 30 frames per second


# Layouts


@pytest.mark.parametrize("fps_member", ["mocap_framerate", "mocap_frame_rate", "fps"])
def test_plain_smpl_is_read_as_it_is(tmp_path, fps_member):
    pose = _axis_angles(24)
    file = _save(tmp_path / "a.npz", poses=_flat(pose), trans=TRANS, **{fps_member: 25.0})
    motion = load_motion(file, _skeleton())
    assert_allclose(motion.rotations, axis_angle_to_matrix(pose), atol=ROUND_OFF)
    assert (motion.translations == TRANS).all()
    assert (motion.fps, motion.frame_count, motion.joint_names, motion.notes) == (25.0, 5, SMPL_NAMES, ())
    assert motion.duration == 4 / 25
    assert motion.source == str(file)


@pytest.mark.parametrize(
    ("names", "root", "fps_member", "hands"),
    [
        (SMPLH_NAMES, SMPL_REST_ROOT, "mocap_framerate", (22, 37)),
        (SMPLX_NAMES, SMPLX_REST_ROOT, "mocap_frame_rate", (25, 40)),
    ],
)
def test_amass_is_turned_upright_and_mapped_by_name(tmp_path, names, root, fps_member, hands):
    pose, skeleton = _axis_angles(len(names)), _skeleton()
    file = _save(
        tmp_path / "a.npz",
        **{"poses": _flat(pose), "trans": TRANS, fps_member: 120.0, "betas": np.zeros(16), "gender": b"male"},
    )
    motion = load_motion(file, skeleton)
    assert motion.fps == 120.0
    columns = [*range(22), *hands]  # ml-hugs: SMPL's hands are the index fingers' base joints
    assert_allclose(motion.rotations[:, 1:], axis_angle_to_matrix(pose[:, columns])[:, 1:], atol=ROUND_OFF)
    # a Z-up world point (x, y, z) is (x, z, −y) of ours, so what pointed along its +Z points along our +Y
    upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert_allclose(motion.rotations[:, 0], upright @ axis_angle_to_matrix(pose[:, 0]), atol=ROUND_OFF)
    pelvis = skeleton.rest_joints[0] + motion.translations
    x, y, z = (root + TRANS).T
    assert_allclose(pelvis, np.stack([x, z, -y], -1), atol=ROUND_OFF)
    assert any("betas" in note for note in motion.notes)


@pytest.mark.parametrize(
    ("members", "count"),
    [
        ({"poses": (66,)}, 22),
        ({"pose_body": (63,), "root_orient": (3,)}, 22),
        ({"body_pose": (63,), "global_orient": (3,)}, 22),
        ({"body_pose": (69,), "global_orient": (3,)}, 24),
        ({"poses": (69,), "root_orient": (3,)}, 24),
    ],
)
def test_subsets_of_smpl_work_by_name(tmp_path, members, count):
    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(size=(FRAMES, *shape)) * 0.5 for name, shape in members.items()}
    motion = load_motion(_save(tmp_path / "a.npz", **arrays, transl=TRANS, fps=30), _skeleton())
    pose = np.concatenate([arrays[name] for name in reversed(members)], 1).reshape(FRAMES, -1, 3)
    assert_allclose(motion.rotations[:, :count], axis_angle_to_matrix(pose), atol=ROUND_OFF)
    assert_allclose(motion.rotations[:, count:], np.broadcast_to(np.eye(3), (FRAMES, 24 - count, 3, 3)))
    assert (motion.translations == TRANS).all()
    at_rest = [note for note in motion.notes if "rest" in note]
    assert at_rest == (["joints that the motion lacks stay at rest: left_hand, right_hand"] if count == 22 else [])


@pytest.mark.parametrize("suffix", ["", "_all"])
def test_easymocap_turns_about_the_origin(tmp_path, suffix):
    """v = R(Rh) · lbs(v) + Th: a body point p of SMPL's rest pose ends at R p + Th."""
    rng = np.random.default_rng(2)
    turn, shift = rng.normal(size=(FRAMES, 1, 3)), rng.normal(size=(FRAMES, 1, 3))
    pose = _axis_angles(24)
    pose[:, 0] = 0
    members = {f"poses{suffix}": pose, f"Rh{suffix}": turn, f"Th{suffix}": shift}
    skeleton = smpl_skeleton(np.concatenate([[SMPL_REST_ROOT], rng.normal(size=(23, 3))]))
    motion = load_motion(_save(tmp_path / "a.npz", **members, fps=60), skeleton)
    root = skeleton.joint_transforms(motion.rotations, motion.translations)[:, 0]
    point = np.array([0.3, 0.5, -0.2])
    ours = (root @ [*(point - SMPL_REST_ROOT), 1])[:, :3]
    x, y, z = (axis_angle_to_matrix(turn[:, 0]) @ point + shift[:, 0]).T
    assert_allclose(ours, np.stack([x, z, -y], -1), atol=ROUND_OFF)
    assert_allclose(motion.rotations[:, 1:], axis_angle_to_matrix(pose[:, 1:]), atol=ROUND_OFF)


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here; all else here is self-made")
def test_the_real_dance_stands_on_the_floor():
    skeleton = _real_skeleton()
    file = SHARED_DATA / "motion" / "aistpp_gBR_sBM_cAll_d04_mBR0_ch01.npz"
    assert any("60 frames per second assumed" in note for note in load_motion(file, skeleton).notes)
    motion = load_motion(file, skeleton, fps=15)  # every fourth frame of 60: at 60 hands would do 22 m/s
    joints = skeleton.joint_transforms(motion.rotations, motion.translations)[..., :3, 3]
    head, pelvis = joints[:, SMPL_NAMES.index("head"), 1], joints[:, 0, 1]
    assert motion.frame_count == 180
    assert (head > pelvis).all() and 0.7 < pelvis.mean() < 1.1  # upright, at a dancer's height
    # the toes of a body with other legs than the dancer's come within 15 cm of the floor
    assert np.abs(joints[..., 1].min(1)).max() < 0.15
    assert np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() * motion.fps < 8  # m/s: no limb jumps


def _real_skeleton() -> Skeleton:
    with np.load(SHARED_DATA / "capture" / "body.npz") as body:
        return Skeleton(tuple(body["joint_names"]), body["joint_parents"], body["rest_joints"])


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_damaged_in_any_compression_are_refused(tmp_path, method):
    member = io.BytesIO()
    np.save(member, np.random.default_rng(0).normal(size=(100, 24, 3)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("poses.npy", member.getvalue())
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[60:90] = bytes(30)
    (tmp_path / "a.npz").write_bytes(data)
    reason = "expected an array, got data that is cut short or damaged"
    if method != zipfile.ZIP_DEFLATED:  # numpy writes no other, and zipfile expands them without a bound
        reason = "expected none or deflate, got"
    with pytest.raises(InputError, match=rf"a\.npz: .*poses.*: {reason}"):
        load_motion(tmp_path / "a.npz", _skeleton())


# Axes, rates, joints


def test_up_axis_argument_beats_the_file_which_beats_the_layout(tmp_path):
    pose = _axis_angles(24)
    plain = axis_angle_to_matrix(pose[:, 0])
    upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ plain
    silent = _save(tmp_path / "a.npz", poses=pose, trans=TRANS, fps=30)
    z_up = _save(tmp_path / "b.npz", poses=pose, trans=TRANS, fps=30, up_axis="Z")
    for file, up, expected in (
        (silent, "auto", plain),
        (silent, "y", plain),
        (silent, "z", upright),
        (z_up, "auto", upright),
        (z_up, "y", plain),
    ):
        root = load_motion(file, _skeleton(), up=up).rotations[:, 0]
        assert_allclose(root, expected, atol=ROUND_OFF, err_msg=f"{file.name} {up}")


def test_a_root_that_is_called_so_counts_wherever_it_stands(tmp_path):
    """Else what hangs on it would be turned by the file's own root, which stands still."""
    pose = _axis_angles(3)
    pose[:, 0] = 0
    file = _save(tmp_path / "a.npz", poses=_flat(pose), trans=TRANS, fps=30, joint_names=["world", "leg", "root"])
    motion = load_motion(file, Skeleton(("root", "leg"), [-1, 0], np.zeros((2, 3))))
    assert_allclose(motion.rotations, axis_angle_to_matrix(pose)[:, [2, 1]], atol=ROUND_OFF)


def test_a_root_above_the_pelvis_turns_it(tmp_path):
    """What a world joint does first, the pelvis does within it; a joint of the avatar's is above nobody."""
    pose = _axis_angles(3)
    turns = axis_angle_to_matrix(pose)
    skeleton = Skeleton(("pelvis", "leg"), [-1, 0], np.zeros((2, 3)))
    for above, expected in (("world", turns[:, 0] @ turns[:, 1]), ("leg", turns[:, 1])):
        names = [above, "pelvis", "leg" if above == "world" else "arm"]
        file = _save(tmp_path / "a.npz", poses=_flat(pose), trans=TRANS, fps=30, joint_names=names)
        motion = load_motion(file, skeleton)
        assert_allclose(motion.rotations[:, 0], expected, atol=ROUND_OFF)
        assert motion.notes == (("world, above pelvis, rotates all below it",) if above == "world" else ())
        assert motion.left_out == (() if above == "world" else ("arm",))


def test_missing_frame_rate_is_sixty_and_noted_unless_given(tmp_path):
    file = _save(tmp_path / "a.npz", poses=_axis_angles(24), trans=TRANS)
    motion = load_motion(file, _skeleton())
    assert motion.fps == 60 and "60" in motion.notes[0]
    motion = load_motion(file, _skeleton(), fps=24)
    assert motion.fps == 24 and motion.notes == ()


def test_joints_are_matched_by_name_in_any_order(tmp_path):
    pose = _axis_angles(3)
    file = _save(tmp_path / "a.npz", poses=_flat(pose), trans=TRANS, fps=30, joint_names=["hips", "arm", "leg"])
    skeleton = Skeleton(("root", "leg", "tail", "arm"), [-1, 0, 0, 0], np.zeros((4, 3)))
    motion = load_motion(file, skeleton)
    assert motion.joint_names == skeleton.names
    expected = axis_angle_to_matrix(pose)
    assert_allclose(motion.rotations[:, [0, 1, 3]], expected[:, [0, 2, 1]], atol=ROUND_OFF)
    assert_allclose(motion.rotations[:, 2], np.broadcast_to(np.eye(3), (FRAMES, 3, 3)))
    assert motion.notes == ("joints that the motion lacks stay at rest: tail",)


def test_fingers_drive_fingers_where_the_avatar_has_them(tmp_path):
    pose = _axis_angles(52)
    names = ("pelvis", "left_wrist", "left_index1", "right_thumb3")
    skeleton = Skeleton(names, [-1, 0, 1, 0], np.zeros((4, 3)))
    motion = load_motion(_save(tmp_path / "a.npz", poses=_flat(pose), trans=TRANS, fps=30), skeleton)
    columns = [SMPLH_NAMES.index(name) for name in names]
    assert_allclose(motion.rotations[:, 1:], axis_angle_to_matrix(pose[:, columns[1:]]), atol=ROUND_OFF)


def test_no_joint_in_common_is_refused(tmp_path):
    file = _save(tmp_path / "a.npz", poses=_axis_angles(24), trans=TRANS, fps=30)
    skeleton = Skeleton(("bone.000", "bone.001", "bone.002"), [-1, 0, 1], np.zeros((3, 3)))
    with pytest.raises(InputError) as caught:
        load_motion(file, skeleton)
    assert "bone.000" in str(caught.value) and "pelvis" in str(caught.value)


def test_save_and_load_give_the_same_motion_for_any_skeleton(tmp_path):
    for joints in (24, 31, 52):  # 31: no layout of its own; 52: would be SMPL-H and Z up without its names
        names = SMPL_NAMES if joints == 24 else tuple(f"joint{k}" for k in range(joints))
        parents = SMPL_PARENTS if joints == 24 else range(-1, joints - 1)
        skeleton = Skeleton(names, np.array(parents), np.random.default_rng(0).normal(size=(joints, 3)))
        motion = Motion(axis_angle_to_matrix(_axis_angles(joints)), TRANS, 29.97, names)
        save_motion(tmp_path / "a.npz", motion)
        back = load_motion(tmp_path / "a.npz", skeleton)
        assert_allclose(back.rotations, motion.rotations, atol=ROUND_OFF)
        assert (back.translations == TRANS).all() and (back.fps, back.notes) == (29.97, ())
        with np.load(tmp_path / "a.npz") as members:  # what other readers go by
            assert members["poses"].shape == (FRAMES, 3 * joints) and members["up_axis"] == "y"
        first = (tmp_path / "a.npz").read_bytes()
        save_motion(tmp_path / "a.npz", motion)
        assert (tmp_path / "a.npz").read_bytes() == first


# Sampling


def test_sampling_interpolates_on_the_shortest_path_and_clamps():
    angles = np.zeros((3, 2, 3))
    angles[:, 1, 2] = [np.pi - 0.2, np.pi + 0.2 - 2 * np.pi, np.pi + 0.6]  # steady, but written across the wrap
    motion = Motion(axis_angle_to_matrix(angles), np.array([[0.0, 0, 0], [2, 0, 0], [2, 4, 0]]), 10.0, ("a", "b"))
    times = [-5.0, 0.0, 0.05, 0.1, 0.125, 0.2, 99.0]
    sampled = motion.at(times)
    expected = np.pi + np.array([-0.2, -0.2, 0.0, 0.2, 0.3, 0.6, 0.6])
    expected_rotations = axis_angle_to_matrix(np.outer(expected, [0, 0, 1]))
    assert_allclose(sampled.rotations[:, 1], expected_rotations, atol=ROUND_OFF)
    moves = [[0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [2, 4, 0], [2, 4, 0]]
    assert_allclose(sampled.translations, moves, atol=ROUND_OFF)
    assert sampled.joint_names == motion.joint_names


# Refusals


def _broken(array: np.ndarray, value: float, frame: int) -> np.ndarray:
    array = array.copy()
    array[frame, 1] = value
    return array


POSES = _flat(_axis_angles(24))


@pytest.mark.parametrize(
    ("step", "height", "unit"),
    [
        *((0.1, 1.0, ""), (0.3, 1.0, ""), (0.001, 2.0, "")),
        *((0.001, 950.0, "millimetres"), (0.001, 95.0, "centimetres")),
        *((4.0, 1.0, "millimetres or centimetres"), (100.0, 1.0, "millimetres or centimetres")),
    ],
)
def test_other_units_than_metres_are_noted(tmp_path, step, height, unit):
    """Steps in m (or cm, or mm) at 30 frames per second: a sprinter's is 0.4 m."""
    trans = np.stack([np.arange(FRAMES) * step, np.full(FRAMES, height), np.zeros(FRAMES)], 1)
    file = _save(tmp_path / "a.npz", poses=POSES, trans=trans, mocap_framerate=30.0)
    notes = load_motion(file, _skeleton()).notes
    assert [note.partition("look like ")[2] for note in notes if "look like" in note] == [unit] * bool(unit)


@pytest.mark.parametrize("name", ["times", "timestamps"])
def test_times_give_the_frame_rate_and_are_told_where_uneven(tmp_path, name):
    def load(times: np.ndarray, **members: object) -> Motion:
        file = _save(tmp_path / "a.npz", poses=POSES, trans=TRANS, **{name: times}, **members)
        return load_motion(file, _skeleton())

    even = load(3 + np.arange(FRAMES) / 24)
    assert even.fps == 24 and not any("frame rate" in note or "uneven" in note for note in even.notes)
    assert load(np.arange(FRAMES) / 24, fps=25.0).fps == 25
    gap = load(np.arange(FRAMES) / 24 + 2 * (np.arange(FRAMES) > 2), fps=24.0)
    assert f"{name} are uneven: the frames are played one after the other" in gap.notes
    frames = load(np.arange(FRAMES))  # no seconds
    assert frames.fps == 60 and any("frame rate" in note for note in frames.notes)


def test_times_that_increase_and_names_of_frames_are_no_reason_to_refuse(tmp_path):
    members = {"poses": POSES, "trans": TRANS, "mocap_framerate": 30.0}
    for name, values in {
        "times": np.arange(FRAMES) / 30,
        "frame_ids": ["b", "a", "c", "d", "e"],
        "frame_id": [1],
    }.items():
        load_motion(_save(tmp_path / "a.npz", **members, **{name: values}), _skeleton())


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"poses": POSES[:0], "trans": TRANS[:0]}, ["poses", "at least one frame"]),
        ({"poses": _broken(POSES, np.nan, 3), "trans": TRANS}, ["frame 3", "poses", "finite", "nan"]),
        ({"poses": _broken(POSES, np.inf, 0), "trans": TRANS}, ["frame 0", "poses", "inf"]),
        ({"poses": _broken(POSES, 1e6, 2), "trans": TRANS}, ["frame 2", "poses: pelvis", "rad", "degrees"]),
        ({"poses": POSES, "trans": _broken(TRANS, np.nan, 4)}, ["frame 4", "trans", "finite"]),
        ({"poses": POSES, "trans": _broken(TRANS, 2e4, 1)}, ["frame 1", "trans", "metres", "millimetres"]),
        ({"poses": POSES, "trans": TRANS[:3]}, ["trans", "5×3", "3×3"]),
        ({"poses": POSES.astype(object), "trans": TRANS}, ["poses", "Python objects"]),
        ({"poses": POSES.astype(str), "trans": TRANS}, ["poses", "numbers", "<U"]),
        ({"poses": POSES.astype(complex), "trans": TRANS}, ["poses", "numbers", "complex"]),
        ({"poses": POSES[:, :71], "trans": TRANS}, ["poses", "5×71"]),
        ({"poses": POSES[0], "trans": TRANS}, ["poses", "F×3J", "72"]),
        ({"poses": np.zeros((5, 24, 4)), "trans": TRANS}, ["poses", "5×24×4"]),
        ({"poses": np.zeros((5, 24, 3, 2)), "trans": TRANS}, ["poses", "5×24×3×2"]),
        ({"poses": np.zeros((5, 24, 3, 3)), "trans": TRANS}, ["frame 0", "poses: joint 0", "rotation matrices"]),
        ({"poses": np.float64(3.0)}, ["poses"]),
        ({"poses": np.zeros((5, 75)), "trans": TRANS}, ["22, 24, 52 or 55", "25 joints (75 columns)"]),
        ({"poses": np.zeros((5, 168)), "trans": TRANS}, ["22, 24, 52 or 55", "56 joints (168 columns)"]),
        ({"poses": np.zeros((5, 0)), "trans": TRANS}, ["0 joints"]),
        ({"poses": np.zeros((5, 0)), "joint_names": np.array([], "<U1")}, ["at least one, got none"]),
        ({"poses": POSES, "joint_names": ["a", "b"]}, ["2 joints (6 columns)", "24 joints (72 columns)"]),
        ({"poses": POSES, "joint_names": ["a"] * 24}, ["joint_names", "each name once"]),
        ({"trans": TRANS}, ["poses, poses_all, pose_body or body_pose", "got trans"]),
        ({}, ["an empty archive"]),
        ({"poses_all": POSES, "Rh_all": TRANS}, ["Th is missing"]),
        ({"poses_all": POSES, "Rh_all": TRANS[:2], "Th_all": TRANS}, ["Rh_all", "5×3", "2×3"]),
        ({"poses": POSES, "trans": TRANS, "mocap_framerate": 0.0}, ["mocap_framerate", "per second"]),
        ({"poses": POSES, "trans": TRANS, "mocap_framerate": 1e-5}, ["per second, 0.001 to 10000, got [1e-05]"]),
        ({"poses": POSES, "trans": TRANS, "mocap_framerate": np.nan}, ["mocap_framerate", "finite"]),
        ({"poses": POSES, "trans": TRANS, "fps": [30.0, 30.0]}, ["fps"]),
        ({"poses": POSES, "trans": TRANS, "fps": "30"}, ["fps", "numbers"]),
        ({"poses": POSES, "trans": TRANS, "up_axis": "x"}, ["up_axis", "y or z"]),
        ({"poses": POSES, "trans": TRANS, "times": [0, 1, 2, 2, 3]}, ["frame 3", "times", "increase", "2 after 2"]),
        ({"poses": POSES, "trans": TRANS, "frame_ids": [4, 3, 2, 1, 0]}, ["frame 1", "frame_ids", "3 after 4"]),
    ],
)
def test_bad_motion_is_one_line_naming_file_field_and_frame(tmp_path, members, words):
    file = _save(tmp_path / "bad.npz", **members)
    with pytest.raises(InputError) as caught:
        load_motion(file, _skeleton())
    message = str(caught.value)
    assert message.startswith(f"{file}: ") and "\n" not in message
    for word in words:
        assert word in message, message


def test_text_of_numbers_that_are_no_characters_is_refused(tmp_path):
    """numpy and Python take them; printing them fails."""
    names = np.array(["ab"] * 24)
    names.view(np.uint32)[::2] = [*range(0x110000, 0x110018)]
    file = _save(tmp_path / "bad.npz", poses=POSES, joint_names=names)
    with pytest.raises(InputError, match=r"joint_names: expected strings, got damaged ones"):
        load_motion(file, _skeleton())


def test_files_that_are_no_archives(tmp_path):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, poses=POSES, trans=TRANS)
    whole = buffer.getvalue()
    scrambled = bytearray(whole)
    scrambled[200:400] = bytes(200)
    np.save(tmp_path / "array.npy", POSES)
    contents = {
        "empty.npz": b"",
        "text.npz": b"hello world",
        "cut.npz": whole[: len(whole) // 2],
        "scrambled.npz": bytes(scrambled),
        "pickle.npz": b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x07walk.py\x94.",
        "array.npz": (tmp_path / "array.npy").read_bytes(),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError) as caught:
            load_motion(tmp_path / name, _skeleton())
        assert str(tmp_path / name) in str(caught.value), name
    with pytest.raises(InputError, match="motion not found"):
        load_motion(tmp_path / "none.npz", _skeleton())


def test_header_that_claims_a_huge_array_is_refused(tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 72), }"
    header += b" " * (64 - (10 + len(header) + 1) % 64) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("poses.npy", member)
    with pytest.raises(InputError, match="poses"):
        load_motion(tmp_path / "huge.npz", _skeleton())


def test_objects_beside_the_motion_are_never_touched(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("unpickled",))

    file = _save(tmp_path / "a.npz", poses=POSES, trans=TRANS, fps=30, extra=np.array([Bomb()], object))
    assert load_motion(file, _skeleton()).frame_count == FRAMES


@pytest.mark.parametrize("fps", [0.0, -1.0, np.nan, np.inf])
def test_bad_frame_rate_argument(tmp_path, fps):
    file = _save(tmp_path / "a.npz", poses=POSES, trans=TRANS, fps=30)
    with pytest.raises(InputError, match="fps"):
        load_motion(file, _skeleton(), fps=fps)
