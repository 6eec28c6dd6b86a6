"""One known motion, written in everybody's layout: all of them import to the same rotations and the same path."""

import json
import pickle  # noqa: TID251  # to write what others write
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.joint_names import load_joint_map, match_joints
from rnd_runtime.motion.motion import load_motion, motion_inputs
from rnd_runtime.motion.retarget import Retargeted, retarget
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS, SMPL_REST_ROOT, SMPLH_NAMES, SMPLX_NAMES, SMPLX_REST_ROOT
from support.paths import ASSETS, SHARED

SKELETON = Body.load(ASSETS / "body.npz").skeleton
SHARED_DATA = SHARED / "data" / "motion"
FRAMES = 12
DOUBLE, SINGLE = 1e-9, 2e-6
TEXT = 1e-5  # BVH and AMC below are written with six digits behind the point
METRES = 1e-4  # their root's place in hundredths or inches, and the floor
Y_UP = np.eye(3)
Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])  # a point (x, y, z) of ours is (x, −z, y) there


def _motion() -> tuple[np.ndarray, np.ndarray]:
    """Axis-angles [F, 24, 3] of somebody who waves and steps, hands at rest, and the pelvis' place [F, 3] m."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 1, FRAMES)[:, None, None]
    poses = 0.5 * np.sin(2 * np.pi * t + rng.normal(size=(24, 3))) * rng.uniform(0.2, 1, (24, 3))
    poses[:, 22:] = 0
    pelvis = np.stack([0.3 * t[:, 0, 0], 0.95 + 0.03 * np.sin(6 * t[:, 0, 0]), -0.2 * t[:, 0, 0]], -1)
    return poses, pelvis


POSES, PELVIS = _motion()
MATRICES = Rotation.from_rotvec(POSES.reshape(-1, 3)).as_matrix().reshape(FRAMES, 24, 3, 3)


def _z_up(axis_angles: np.ndarray) -> np.ndarray:
    turned = axis_angles.copy()
    turned[:, 0] = (Rotation.from_matrix(Z_UP) * Rotation.from_rotvec(axis_angles[:, 0])).as_rotvec()
    return turned


def _wide(names: tuple[str, ...]) -> np.ndarray:
    """The poses with everybody else's joints, fingers and face at rest."""
    wide = np.zeros((FRAMES, len(names), 3))
    wide[:, :22] = POSES[:, :22]
    return wide


def _flat(poses: np.ndarray) -> np.ndarray:
    return poses.reshape(len(poses), -1)


def _pickle(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def _npz(path: Path, **members: object) -> Path:
    np.savez(path, **members)
    return path


def _amass(folder, names=SMPLH_NAMES, root=SMPL_REST_ROOT, fps="mocap_framerate"):
    poses = _flat(_z_up(_wide(names)))
    return _npz(folder / "a.npz", **{"poses": poses, "trans": PELVIS @ Z_UP.T - root, fps: 30.0, "gender": "neutral"})


def _stageii(folder, fingers=True):
    """Newer AMASS without its joined ``poses``."""
    poses = _flat(_z_up(_wide(SMPLX_NAMES)))
    hands = {"pose_hand": poses[:, 75:]} if fingers else {}
    return _npz(
        folder / "walk_stageii.npz",
        root_orient=poses[:, :3],
        pose_body=poses[:, 3:66],
        **hands,
        pose_jaw=poses[:, 66:69],
        pose_eye=poses[:, 69:75],
        trans=PELVIS @ Z_UP.T - SMPLX_REST_ROOT,
        mocap_frame_rate=30.0,
        surface_model_type="smplx",
        mocap_time_length=0.4,
        betas=np.zeros(16),
    )


def _easymocap(folder, suffix="", shape=(FRAMES, 3)):
    """x = R(Rh) X + Th about the origin, Z up: Th = trans + J0 − R J0."""
    root = Rotation.from_matrix(Z_UP) * Rotation.from_rotvec(POSES[:, 0])
    place = PELVIS @ Z_UP.T - root.apply(SMPL_REST_ROOT)
    poses = POSES.copy()
    poses[:, 0] = 0
    members = {f"poses{suffix}": _flat(poses) if not suffix else poses, f"Rh{suffix}": root.as_rotvec().reshape(shape)}
    return _npz(folder / "motion.npz", **members, **{f"Th{suffix}": place.reshape(shape)}, fps=30.0)


def _easymocap_json(folder, frames=range(7, 7 + FRAMES), columns=72, root=SMPL_REST_ROOT):
    """EasyMocap's own: a file a frame, Z up, somebody else in the first half; ``columns`` by body model."""
    turn = Rotation.from_matrix(Z_UP) * Rotation.from_rotvec(POSES[:, 0])
    place = PELVIS @ Z_UP.T - turn.apply(root)
    poses = np.zeros((FRAMES, columns))
    poses[:, 3:66] = _flat(POSES[:, 1:22])
    poses[:, 72:] = 0.3  # coefficients of hands and face, which are no angles
    (folder / "smpl").mkdir()
    for k, frame in enumerate(frames):
        ours = {
            "id": 1,
            "Rh": [turn.as_rotvec()[k].tolist()],
            "Th": [place[k].tolist()],
            "poses": [poses[k].tolist()],
            "shapes": [[0.0] * 10],
        }
        people = [ours | {"id": 0}, ours] if k < FRAMES // 2 else [ours]
        (folder / "smpl" / f"{frame:06d}.json").write_text(json.dumps(people))
    return folder / "smpl"


def _rootless(folder):
    """The 69 columns that its older versions leave."""
    files = _easymocap_json(folder)
    for file in files.iterdir():
        people = json.loads(file.read_text())
        file.write_text(json.dumps([one | {"poses": [one["poses"][0][3:]]} for one in people]))
    return files


def _before_a_camera() -> tuple[np.ndarray, np.ndarray]:
    """Rotations [F, 24, 3, 3] and SMPL's trans in the axes of a level camera: right, down, forward."""
    level = np.diag([1.0, -1, -1])
    matrices = MATRICES.copy()
    matrices[:, 0] = level @ matrices[:, 0]
    places = PELVIS - PELVIS[0] * [1, 0, 1] + np.array([0.4, 0, -6.0])
    return matrices, places @ level - SMPL_REST_ROOT


def _phalp(folder, frames=range(FRAMES)):
    """PHALP's and 4D-Humans': matrices by picture, another person first in every other one."""
    matrices, trans = _before_a_camera()
    far = 5000 / 256 / 1.2  # its lens is longer than the one we assume, and people are as much farther away
    trans[:, 2] = far * (SMPL_REST_ROOT[2] + trans[:, 2]) - SMPL_REST_ROOT[2]
    content = {}
    for k, frame in enumerate(frames):
        smpl = {
            "global_orient": matrices[k, :1].astype(np.float32),
            "betas": np.zeros(10, np.float32),
            "body_pose": matrices[k, 1:].astype(np.float32),
        }
        tracks, people, places = [4], [smpl], [trans[k]]
        if k % 2:
            tracks, people, places = [2, 4], [smpl, smpl], [np.ones(3), trans[k]]
        content[f"img/{frame:06d}.jpg"] = {"time": frame, "tid": tracks, "smpl": people, "camera": places}
    return _pickle(folder / "phalp_me.pkl", content)


def _wham_in_camera(folder):
    """WHAM without its estimate of the world."""
    matrices, trans = _before_a_camera()
    pose = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(FRAMES, 72)
    return _pickle(folder / "wham_output.pkl", {0: {"pose": pose, "trans": trans, "frame_ids": np.arange(FRAMES)}})


def _aist(folder):
    scaling = 93.7
    content = {
        "smpl_poses": _flat(POSES).astype(np.float32),
        "smpl_trans": (PELVIS - SMPL_REST_ROOT) * scaling,
        "smpl_scaling": np.array([scaling]),
        "smpl_loss": 0.1,
    }
    return _pickle(folder / "gBR.pkl", content)


def _wham(folder):
    """Two people; the longer track has a gap of one frame in the middle of a steady turn."""
    track = {
        "pose": np.zeros((FRAMES, 72)),
        "trans": np.zeros((FRAMES, 3)),
        "pose_world": _flat(POSES),
        "trans_world": PELVIS - SMPL_REST_ROOT,
        "betas": np.zeros((FRAMES, 10)),
        "frame_ids": np.arange(7, 7 + FRAMES),
    }
    short = {name: value[:4] for name, value in track.items()}
    return _pickle(folder / "wham_output.pkl", {0: short, 3: track})


def _gvhmr(folder):
    tensors = {
        "body_pose": _flat(POSES[:, 1:22]),
        "global_orient": POSES[:, 0],
        "transl": PELVIS - SMPLX_REST_ROOT,
        "betas": np.zeros((FRAMES, 10)),
    }
    tensors = {name: torch.tensor(value, dtype=torch.float32) for name, value in tensors.items()}
    incam = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
    content = {"smpl_params_global": tensors, "smpl_params_incam": incam, "K_fullimg": torch.eye(3)}
    torch.save(content, folder / "hmr4d_results.pt")
    return folder / "hmr4d_results.pt"


def _mdm(folder):
    """MDM's own: 6D of pytorch3d, which is the first two rows, frames last."""
    content = {
        "thetas": MATRICES[..., :2, :].reshape(FRAMES, 24, 6).transpose(1, 2, 0).astype(np.float32),
        "root_translation": PELVIS.T,
        "text": "a person waves",
        "length": FRAMES,
    }
    np.save(folder / "sample00_rep00_smpl_params.npy", content, allow_pickle=True)
    return folder / "sample00_rep00_smpl_params.npy"


def _gomavatar(folder):
    """GoMAvatar's copy of it: axis-angle, a torch tensor inside the pickle."""
    content = {"thetas_ori": torch.tensor(POSES.transpose(1, 2, 0)), "root_translation": PELVIS.T}
    np.save(folder / "sample.npy", content, allow_pickle=True)
    return folder / "sample.npy"


LAYOUTS = {
    "AMASS, SMPL-H": (_amass, 30, DOUBLE),
    "AMASS, SMPL-X": (lambda f: _amass(f, SMPLX_NAMES, SMPLX_REST_ROOT, "mocap_frame_rate"), 30, DOUBLE),
    "AMASS, split": (_stageii, 30, DOUBLE),
    "AMASS, split, body only": (lambda f: _stageii(f, fingers=False), 30, DOUBLE),
    "EasyVolcap": (_easymocap, 30, DOUBLE),
    "pose_seq": (lambda f: _easymocap(f, "_all", (FRAMES, 1, 3)), 30, DOUBLE),
    "EasyMocap, SMPL": (_easymocap_json, 30, DOUBLE),
    "EasyMocap, SMPL-H": (lambda f: _easymocap_json(f, columns=78), 30, DOUBLE),
    "EasyMocap, SMPL-X": (lambda f: _easymocap_json(f, columns=87, root=SMPLX_REST_ROOT), 30, DOUBLE),
    "EasyMocap without its root": (_rootless, 30, DOUBLE),
    "AIST++": (_aist, 60, SINGLE),
    "WHAM": (_wham, 30, DOUBLE),
    "GVHMR": (_gvhmr, 30, SINGLE),
    "MDM": (_mdm, 20, SINGLE),
    "GoMAvatar": (_gomavatar, 20, DOUBLE),
    "dict in a pickle": (
        lambda f: _pickle(f / "a.pkl", {"poses": POSES, "trans": PELVIS - SKELETON.rest_joints[0], "fps": 30}, 2),
        30,
        DOUBLE,
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_the_same_motion(tmp_path, layout):
    write, fps, tolerance = LAYOUTS[layout]
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == fps
    assert_allclose(motion.rotations, MATRICES, atol=tolerance)
    assert_allclose(motion.translations + SKELETON.rest_joints[0], PELVIS, atol=tolerance)


def test_wham_takes_the_longest_track_and_fills_its_gaps(tmp_path):
    file = _wham(tmp_path)
    people = pickle.loads(file.read_bytes())
    steady = np.zeros((5, 72))
    steady[:, 0] = np.array([0, 0.1, 0.2, 0.5, 0.6])  # the frame ids say when
    trans = np.stack([steady[:, 0]] * 3, -1)
    people[9] = {"pose": steady[:2], "trans": trans[:2]}
    people[5] = {
        "pose": np.zeros((20, 72)),
        "trans": np.zeros((20, 3)),
        "pose_world": np.tile(steady, (4, 1)),
        "trans_world": np.tile(trans, (4, 1)),
        "frame_ids": [0, 1, 2, 5, 6, *range(10, 25)],
    }
    motion = load_motion(_pickle(file, people), SKELETON)
    assert motion.frame_count == 25
    angles = Rotation.from_matrix(motion.rotations[:7, 0]).as_rotvec()[:, 0]
    assert_allclose(angles, np.linspace(0, 0.6, 7), atol=DOUBLE)
    notes = " ".join(motion.notes)
    assert "person 5" in notes and "left out: 0, 3, 9" in notes and "5 frames" in notes and "frame rate" in notes


def test_of_whams_repeated_frames_the_first_counts_as_for_rnd_data_import(tmp_path):
    file = _wham(tmp_path)
    people = pickle.loads(file.read_bytes())
    track = {name: np.concatenate([value[3:], value[:4] * 2]) for name, value in people[3].items()}
    track["frame_ids"] = np.concatenate([people[3]["frame_ids"][3:], people[3]["frame_ids"][:4]])
    motion = load_motion(_pickle(file, {3: track}), SKELETON)
    assert_allclose(motion.rotations[3:], MATRICES[3:], atol=SINGLE)
    assert motion.frame_count == FRAMES and not np.allclose(motion.rotations[2], MATRICES[2], atol=0.01)
    track["frame_ids"] = track["frame_ids"][1:]
    with pytest.raises(InputError, match=rf"wham_output.pkl: poses of a track: .* got {FRAMES + 1} and {FRAMES}"):
        load_motion(_pickle(file, {3: track}), SKELETON)


@pytest.mark.parametrize("write", [_phalp, _wham_in_camera])
def test_what_a_camera_saw_is_turned_upright_over_the_origin(tmp_path, write):
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == 30 and any("taken to stand level" in note for note in motion.notes)
    assert_allclose(motion.rotations, MATRICES, atol=SINGLE)
    path = motion.translations + SKELETON.rest_joints[0]
    assert_allclose(path, PELVIS - PELVIS[0] * [1, 0, 1], atol=SINGLE)


@pytest.mark.parametrize("write", [_phalp, _easymocap_json])
def test_gaps_are_filled_and_others_named(tmp_path, write):
    frames = [0, 1, *range(4, FRAMES + 2)]
    motion = load_motion(write(tmp_path, frames), SKELETON)
    assert motion.frame_count == FRAMES + 2
    assert_allclose(motion.rotations[4:], MATRICES[2:], atol=SINGLE)
    steps = np.diff(motion.translations[1:5], axis=0)
    assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=SINGLE)
    notes = " ".join(motion.notes)
    assert "2 frames without the person" in notes and "left out: " in notes and "frame rate" in notes


@pytest.mark.parametrize("write", [_phalp, _easymocap_json])
def test_numbers_that_leave_out_hours_are_refused(tmp_path, write):
    with pytest.raises(InputError, match="frame numbers: expected at most 18000 left out, got 9999"):
        load_motion(write(tmp_path, [*range(FRAMES - 1), 99_999_999]), SKELETON)


@pytest.mark.parametrize(("first", "said"), [([0, 0], "0 after 0"), ([0, 1, 1, 5], "1 after 1")])
def test_pictures_of_the_same_time_are_refused(tmp_path, first, said):
    path = _phalp(tmp_path)
    content = pickle.loads(path.read_bytes())
    for time, moment in zip([*first, *range(9, 9 + FRAMES)], content.values()):
        moment["time"] = time
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(InputError, match=f"frame numbers: expected some that ascend, got {said}"):
        load_motion(path, SKELETON)


def test_a_folder_that_is_no_motion_is_refused_in_one_line(tmp_path):
    def refusal(text=None) -> str:
        if text is not None:
            (tmp_path / "000000.json").write_text(text)
        with pytest.raises(InputError) as caught:
            load_motion(tmp_path, SKELETON)
        return str(caught.value)

    assert "expected .json files, got none" in refusal()
    assert "000000.json" in refusal("{") and "000000.json" in refusal("3") and "000000.json" in refusal("[3]")
    assert "at least one" in refusal("[]")
    assert "Rh, Th, poses, shapes" in refusal('[{"id": 0, "Rh": [[0, 0, 0]]}]')
    assert "000000.json" in refusal('[{"id": "me"}]')
    person = {"id": 0, "Rh": [0, 0, 0], "Th": [0, 0, 0], "poses": [0] * 30, "shapes": [0]}
    assert "joints of the motion" in refusal(json.dumps([person]))
    assert "finite" in refusal(json.dumps([person | {"poses": [float("nan")] * 72}]))
    assert "expected 3 numbers" in refusal(json.dumps([person | {"Th": [0]}]))


@pytest.mark.parametrize("columns", [0, 2, 70])
def test_poses_of_no_whole_joints_are_refused_with_and_without_gaps(tmp_path, columns):
    person = {"id": 0, "Rh": [0, 0, 0], "Th": [0, 0, 0], "poses": [0.0] * columns, "shapes": [0]}
    for frame in (0, 1, 4):
        (tmp_path / f"{frame:06d}.json").write_text(json.dumps([person]))
        if frame:
            with pytest.raises(InputError):
                load_motion(tmp_path, SKELETON)


@pytest.mark.parametrize(
    "content", [{}, [1], {"a": 1}, {"smpl_poses": [[0] * 72]}, {0: {"pose": [[0] * 72], "trans": 3}}]
)
def test_other_pickles_are_refused_in_one_line(tmp_path, content):
    with pytest.raises(InputError) as caught:
        load_motion(_pickle(tmp_path / "a.pkl", content), SKELETON)
    assert "a.pkl" in str(caught.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scaling", [0.0, -1.0, np.nan])
def test_an_aist_scaling_that_is_none_is_refused(tmp_path, scaling):
    content = {"smpl_poses": _flat(POSES), "smpl_trans": PELVIS, "smpl_scaling": np.array([scaling])}
    with pytest.raises(InputError, match=r"a\.pkl: smpl_scaling: expected 1e-06 to 1e\+06, got"):
        load_motion(_pickle(tmp_path / "a.pkl", content), SKELETON)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("second", [[0, 0, 0], [2, 0, 0]], ids=["zero", "parallel"])
def test_two_rows_that_are_no_rotation_are_refused(tmp_path, second):
    thetas = MATRICES[..., :2, :].reshape(FRAMES, 24, 6).transpose(1, 2, 0).copy()
    thetas[5, :, 2] = [1, 0, 0, *second]
    with pytest.raises(InputError, match=r"a\.pkl: frame 2: thetas: expected two rows of a rotation"):
        load_motion(_pickle(tmp_path / "a.pkl", {"thetas": thetas, "root_translation": PELVIS.T}), SKELETON)


# Skeletons of their own


def _zero_pose(spread: dict[str, float]) -> np.ndarray:
    """[24, 3, 3] world rotations from our rest pose to another, whose limbs are swung by ``spread`` rad.

    A bone is swung across its own direction: a file's zero pose shows where bones point, not how they are twisted.
    """
    turns = np.tile(np.eye(3), (24, 1, 1))
    for joint, parent in enumerate(SMPL_PARENTS):
        if joint:
            turns[joint] = turns[parent]
        if SMPL_NAMES[joint] in spread:
            bone = SKELETON.rest_joints[SMPL_PARENTS.index(joint)] - SKELETON.rest_joints[joint]
            across = np.array([0, 0, 1]) - bone[2] * bone / (bone @ bone)
            swing = Rotation.from_rotvec(spread[SMPL_NAMES[joint]] * across / np.linalg.norm(across))
            turns[joint] = turns[joint] @ swing.as_matrix()
    return turns


A_POSE = {"left_shoulder": -0.8, "right_shoulder": 0.8, "left_hip": 0.3, "right_hip": -0.3}


def _bvh(
    path: Path, names: dict[str, str], *, axes=Y_UP, unit=1.0, spread=A_POSE, order="ZXY", t_pose=False, facing=None
) -> Path:
    """The known motion, turned by ``facing``, on a skeleton whose zero pose, axes, unit and names differ from ours."""
    facing = np.eye(3) if facing is None else facing
    zero = _zero_pose(spread)
    offsets = np.zeros((24, 3))
    world = np.empty((FRAMES, 24, 3, 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        world[:, joint] = facing @ MATRICES[:, 0] if joint == 0 else world[:, parent] @ MATRICES[:, joint]
        if joint:
            offsets[joint] = unit * axes @ zero[parent] @ (SKELETON.rest_joints[joint] - SKELETON.rest_joints[parent])
    turned = axes @ world @ np.swapaxes(zero, -1, -2) @ axes.T
    local = turned.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
        local[:, joint] = np.swapaxes(turned[:, parent], -1, -2) @ turned[:, joint]
    places = unit * PELVIS @ facing.T @ axes.T
    if t_pose:
        local = np.concatenate([(axes @ np.swapaxes(zero, -1, -2) @ axes.T)[None] * 0 + _local_rest(zero, axes), local])
        places = np.concatenate([places[:1], places])
    lines = ["HIERARCHY"]

    def write(joint: int, indent: str) -> None:
        lines.append(f"{indent}{'JOINT' if joint else 'ROOT'} {names.get(SMPL_NAMES[joint], f'extra{joint}')}")
        lines.append(f"{indent}{{")
        x, y, z = offsets[joint]
        lines.append(f"{indent}\tOFFSET {x:.8f} {y:.8f} {z:.8f}")
        place = "" if joint else "Xposition Yposition Zposition "
        lines.append(f"{indent}\tCHANNELS {3 if joint else 6} {place}" + " ".join(f"{axis}rotation" for axis in order))
        children = [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint]
        for child in children:
            write(child, indent + "\t")
        if not children:
            lines.extend([f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET 0 0.05 0", f"{indent}\t}}"])
        lines.append(f"{indent}}}")
        sequence.append(joint)

    sequence: list[int] = []
    write(0, "")
    depth_first: list[int] = []
    stack = [0]
    while stack:
        joint = stack.pop()
        depth_first.append(joint)
        stack += [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint][::-1]
    lines += ["MOTION", f"Frames: {len(local)}", "Frame Time: 0.0083333"]
    for frame in range(len(local)):
        angles = [Rotation.from_matrix(local[frame, joint]).as_euler(order, degrees=True) for joint in depth_first]
        numbers = np.concatenate([places[frame], np.ravel(angles)])
        lines.append(" ".join(f"{number:.8f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def _local_rest(zero: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """[24, 3, 3] local rotations on top of the zero pose that give our rest pose."""
    turned = axes @ np.swapaxes(zero, -1, -2) @ axes.T
    local = turned.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
        local[joint] = turned[parent].T @ turned[joint]
    return local


def _names(pattern: dict[str, str], sides: tuple[str, str]) -> dict[str, str]:
    spelled = {}
    for joint, name in pattern.items():
        for side, theirs in zip(("left", "right"), sides) if "*" in joint else (("", ""),):
            spelled[joint.replace("*", side)] = name.replace("*", theirs)
    return spelled


TRUNK = {"pelvis": "Hips", "neck": "Neck", "head": "Head"}
NAMINGS = {
    "smpl": {name: name for name in SMPL_NAMES},
    "mixamo": _names(
        {
            name: f"mixamorig:{theirs}"
            for name, theirs in {
                **TRUNK,
                "spine1": "Spine",
                "spine2": "Spine1",
                "spine3": "Spine2",
                "*_collar": "*Shoulder",
                "*_shoulder": "*Arm",
                "*_elbow": "*ForeArm",
                "*_wrist": "*Hand",
                "*_hip": "*UpLeg",
                "*_knee": "*Leg",
                "*_ankle": "*Foot",
                "*_foot": "*ToeBase",
            }.items()
        },
        ("Left", "Right"),
    ),
    "biped": _names(
        {
            "pelvis": "Bip01 Pelvis",
            "spine1": "Bip01 Spine",
            "spine2": "Bip01 Spine1",
            "spine3": "Bip01 Spine2",
            "neck": "Bip01 Neck",
            "head": "Bip01 Head",
            "*_collar": "Bip01 * Clavicle",
            "*_shoulder": "Bip01 * UpperArm",
            "*_elbow": "Bip01 * Forearm",
            "*_wrist": "Bip01 * Hand",
            "*_hip": "Bip01 * Thigh",
            "*_knee": "Bip01 * Calf",
            "*_ankle": "Bip01 * Foot",
            "*_foot": "Bip01 * Toe0",
        },
        ("L", "R"),
    ),
    "unreal": _names(
        {
            "pelvis": "pelvis",
            "spine1": "spine_01",
            "spine2": "spine_02",
            "spine3": "spine_03",
            "neck": "neck_01",
            "head": "head",
            "*_collar": "clavicle_*",
            "*_shoulder": "upperarm_*",
            "*_elbow": "lowerarm_*",
            "*_wrist": "hand_*",
            "*_hip": "thigh_*",
            "*_knee": "calf_*",
            "*_ankle": "foot_*",
            "*_foot": "ball_*",
        },
        ("l", "r"),
    ),
    "xsens": _names(
        {
            **TRUNK,
            "spine1": "Chest",
            "spine2": "Chest2",
            "spine3": "Chest4",
            "*_collar": "*Collar",
            "*_shoulder": "*Shoulder",
            "*_elbow": "*Elbow",
            "*_wrist": "*Wrist",
            "*_hip": "*Hip",
            "*_knee": "*Knee",
            "*_ankle": "*Ankle",
            "*_foot": "*Toe",
        },
        ("Left", "Right"),
    ),
    "rokoko": _names(
        {
            **TRUNK,
            "spine1": "Spine",
            "spine2": "Spine1",
            "spine3": "Spine2",
            "*_collar": "*Shoulder",
            "*_shoulder": "*Arm",
            "*_elbow": "*ForeArm",
            "*_wrist": "*Hand",
            "*_hip": "*Thigh",
            "*_knee": "*Shin",
            "*_ankle": "*Foot",
            "*_foot": "*Toe",
        },
        ("Left", "Right"),
    ),
    "daz": _names(
        {
            "pelvis": "hip",
            "spine1": "abdomenLower",
            "spine2": "abdomenUpper",
            "spine3": "chestUpper",
            "neck": "neckLower",
            "head": "head",
            "*_collar": "*Collar",
            "*_shoulder": "*ShldrBend",
            "*_elbow": "*ForearmBend",
            "*_wrist": "*Hand",
            "*_hip": "*ThighBend",
            "*_knee": "*Shin",
            "*_ankle": "*Foot",
            "*_foot": "*Toe",
        },
        ("l", "r"),
    ),
}


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
    motion = load_motion(_bvh(tmp_path / "a.bvh", NAMINGS[naming], spread={}), SKELETON)
    assert motion.fps == 120
    assert_allclose(motion.rotations, MATRICES, atol=TEXT)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_zero_pose_axes_units_and_channel_orders_make_no_difference(tmp_path, order, up):
    axes = Z_UP if up == "z" else np.eye(3)
    file = _bvh(tmp_path / "a.bvh", NAMINGS["mixamo"], axes=axes, unit=100 / 2.54, order=order)
    motion = load_motion(file, SKELETON)
    assert_allclose(motion.rotations, MATRICES, atol=TEXT)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)


def test_an_upright_axis_that_the_user_gives_counts(tmp_path):
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"], axes=Z_UP)
    as_said = load_motion(file, SKELETON, up="z")
    assert_allclose(as_said.rotations, MATRICES, atol=TEXT)
    lying = load_motion(file, SKELETON, up="y")
    assert abs(lying.rotations[0, 0] @ [0, 1, 0])[1] < 0.5


def test_feet_come_down_to_the_floor(tmp_path):
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
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
    motion = load_motion(_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]), skeleton)
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
    """Hips at 0.35 m, trunk level: Y stays up, as in the zero pose, and a note says so."""
    level = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    file = _placed(_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], facing=level), 0.35)
    told, as_said = load_motion(file, SKELETON), load_motion(file, SKELETON, up="y")
    assert_allclose(told.rotations, as_said.rotations, atol=TEXT)
    assert abs(told.rotations[:, 0, 1, 1].mean()) < 0.3
    assert "the trunk lies along z, and y stays up, as in the zero pose; --motion-up z overrules" in told.notes
    assert not any("--motion-up" in note for note in as_said.notes)


def test_a_trunk_that_stands_along_another_axis_makes_it_up_with_a_note(tmp_path):
    """A Z-up world on a zero pose that stands along Y: hips a leg above the floor."""
    level = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    motion = load_motion(_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], facing=level), SKELETON)
    assert motion.rotations[:, 0, 1, 1].mean() > 0.9
    assert "z is taken for up, as the trunk stands along it; --motion-up y overrules" in motion.notes


def test_recorded_joints_that_nothing_follows_are_told(tmp_path):
    """Not those that carry others, as the second joint of this spine does."""
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
    assert load_motion(file, SKELETON).left_out == ()  # hands stand still there
    few = [k for k, name in enumerate(SMPL_NAMES) if name not in ("spine2", "head", "left_foot")]
    parents = [-1, 0, 0, 0, 1, 2, 4, 5, 3, 7, 8, 8, 8, 11, 12, 13, 14, 15, 16, 17, 18]
    skeleton = Skeleton(tuple(SMPL_NAMES[k] for k in few), parents, SKELETON.rest_joints[few])
    assert load_motion(file, skeleton).left_out == ("left_foot", "head")


def test_a_recording_is_turned_to_the_front_and_a_reference_pose_left_out(tmp_path):
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=True)
    motion = load_motion(file, SKELETON)
    assert motion.frame_count == FRAMES and any("T-pose" in note for note in motion.notes)
    assert_allclose(motion.rotations, MATRICES, atol=TEXT)
    behind = Rotation.from_euler("y", 170, degrees=True).as_matrix()  # zero pose and world alike
    again = load_motion(_bvh(tmp_path / "b.bvh", NAMINGS["smpl"], axes=behind), SKELETON)
    forward = again.rotations[0, 0] @ [0, 0, 1]
    assert np.degrees(np.arccos(np.clip(forward @ (MATRICES[0, 0] @ [0, 0, 1]), -1, 1))) < 45.1
    assert_allclose(again.rotations[:, 1:], MATRICES[:, 1:], atol=TEXT)


def test_the_motion_begins_facing_the_front_whatever_a_reference_pose_faces(tmp_path):
    facing = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    for t_pose in (False, True):
        motion = load_motion(_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=t_pose, facing=facing), SKELETON)
        assert motion.frame_count == FRAMES and any("turned by -90°" in note for note in motion.notes)
        assert_allclose(motion.rotations, MATRICES, atol=TEXT)
        assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=TEXT)


def test_hips_below_a_root_of_their_own_go_where_they_are_sent(tmp_path):
    """The same motion, its hips moved and turned in the frame of a root that is itself moved and turned."""
    file = _bvh(tmp_path / "a.bvh", NAMINGS["mixamo"], spread={})
    head, _, frames = file.read_text().partition("MOTION\n")
    above = "ROOT Reference\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
    head = head.replace("ROOT", above + "JOINT", 1) + "}\n"
    turn, place = Rotation.from_euler("Y", 70, degrees=True), np.array([1.0, 0.5, -2.0])
    counts, lines = frames.splitlines()[:2], frames.splitlines()[2:]
    for number, line in enumerate(lines):
        values = np.array([float(word) for word in line.split()])
        hips = Rotation.from_euler("ZXY", values[3:6], degrees=True)
        values[:3] = turn.inv().apply(values[:3] - place)
        values[3:6] = (turn.inv() * hips).as_euler("ZXY", degrees=True)
        lines[number] = " ".join(f"{value:.8f}" for value in [*place, 70, 0, 0, *values])
    below = tmp_path / "b.bvh"
    below.write_text(head + "MOTION\n" + "\n".join([*counts, *lines]) + "\n")
    plain, ours = load_motion(file, SKELETON), load_motion(below, SKELETON)
    assert np.ptp(ours.translations, axis=0).max() > 0.1 and ours.notes == plain.notes
    assert_allclose(ours.translations, plain.translations, atol=TEXT)
    assert_allclose(ours.rotations, plain.rotations, atol=TEXT)


@pytest.mark.parametrize("form", ["toml", "json"])
def test_names_we_do_not_know_come_from_the_users_table(tmp_path, form):
    strange = {name: f"B{joint:02d}" for joint, name in enumerate(SMPL_NAMES)}
    file = _bvh(tmp_path / "a.bvh", strange, spread={})
    with pytest.raises(InputError, match="--joint-map"):
        load_motion(file, SKELETON)
    table = tmp_path / f"names.{form}"
    if form == "toml":
        table.write_text("\n".join(f'{ours} = "{theirs}"' for ours, theirs in strange.items()))
    else:
        table.write_text("{" + ", ".join(f'"{a}": ["x", "{b}"]' for a, b in strange.items()) + "}")
    motion = load_motion(file, SKELETON, joint_map=table)
    assert_allclose(motion.rotations, MATRICES, atol=TEXT)


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
    named = _npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=SMPL_NAMES)
    for file in (_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"]), named):
        with pytest.raises(InputError, match=f"t.toml: joint map: expected joints of the {said}"):
            load_motion(file, SKELETON, joint_map=table)


def test_a_joint_map_renames_named_arrays_too(tmp_path):
    names = [f"B{joint}" for joint in range(24)]
    file = _npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=names)
    (tmp_path / "t.toml").write_text("\n".join(f'{ours} = "B{k}"' for k, ours in enumerate(SMPL_NAMES)))
    motion = load_motion(file, SKELETON, joint_map=tmp_path / "t.toml")
    assert_allclose(motion.rotations, MATRICES, atol=DOUBLE)


def test_a_joint_map_counts_where_names_are_known_too(tmp_path):
    """spine3 shall be what the file calls spine1; what is called spine3 there is nobody's."""
    file = _npz(tmp_path / "a.npz", poses=POSES, trans=PELVIS, fps=30, joint_names=SMPL_NAMES)
    (tmp_path / "t.toml").write_text('spine3 = "spine1"')
    motion = load_motion(file, SKELETON, joint_map=tmp_path / "t.toml")
    spine1, spine3 = SMPL_NAMES.index("spine1"), SMPL_NAMES.index("spine3")
    assert_allclose(motion.rotations[:, spine3], MATRICES[:, spine1], atol=DOUBLE)
    assert_allclose(motion.rotations[:, spine1], np.broadcast_to(np.eye(3), (FRAMES, 3, 3)), atol=DOUBLE)
    assert any("stay at rest: spine1" in note for note in motion.notes)


def test_a_mark_of_utf_8_before_a_text_is_no_part_of_it(tmp_path):
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"])
    file.write_text("\ufeff" + file.read_text("utf-8"), "utf-8")
    table = tmp_path / "t.json"
    table.write_text("\ufeff" + json.dumps({"spine1": NAMINGS["smpl"]["spine1"]}), "utf-8")
    assert load_motion(file, SKELETON, joint_map=table).frame_count == FRAMES


BROKEN_BVH = {
    "cut in channels": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 3 Xrotation Yrotation",
    "empty": "",
    "no motion": "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 0\n}\n",
    "text": "HIERARCHY\nROOT a\n{\nOFFSET x 0 0\n",
    "other": "hello world",
    "end site first": "HIERARCHY End Site { OFFSET 0 0 0 } MOTION",
    "offset": "HIERARCHY ROOT a { OFFSET 0 nan 0 CHANNELS 0 } MOTION Frames: 1 Frame Time: 0.1",
    "short": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 3 Frame Time: 0.03 1 2",
    "time": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0 1",
    "channel": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Wrotation } MOTION Frames: 1 Frame Time: 0.1 1",
    "no channels": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 } MOTION Frames: 1000000000000 Frame Time: 0.1",
    "far offset": "HIERARCHY ROOT a { OFFSET 0 1e200 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0.1 1",
    "huge turn": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 2 Frame Time: 0.1 1 1e300",
    "nan": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 2 Frame Time: 0.1 1 nan",
}


@pytest.mark.parametrize("broken", BROKEN_BVH)
def test_broken_bvh_is_refused_in_one_line(tmp_path, broken):
    (tmp_path / "a.bvh").write_text(BROKEN_BVH[broken])
    with pytest.raises(InputError) as caught:
        load_motion(tmp_path / "a.bvh", SKELETON)
    assert "a.bvh" in str(caught.value)
    assert ("frame 1" in str(caught.value)) == (broken in ("nan", "huge turn"))
    assert ("OFFSET: expected" in str(caught.value)) == (broken in ("offset", "far offset"))


def test_what_retargeting_makes_no_numbers_of_is_refused(tmp_path, monkeypatch):
    def torn(*arguments: object) -> Retargeted:
        moved = retarget(*arguments)
        moved.rotations[3, 0] = np.nan
        return moved

    monkeypatch.setattr("rnd_runtime.motion.retarget.retarget", torn)
    with pytest.raises(InputError, match=r"a\.bvh: frame 3: motion: expected finite numbers"):
        load_motion(_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]), SKELETON)


@pytest.mark.parametrize("t_pose", [False, True])
def test_a_recorded_root_too_far_away_is_named_by_its_frame(tmp_path, t_pose):
    file = _bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=t_pose)
    lines = file.read_text().splitlines()
    lines[-1] = " ".join(["90000", *lines[-1].split()[1:]])
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=rf"frame {FRAMES - 1 + t_pose}: trans: expected metres, at most 1000"):
        load_motion(file, SKELETON)


def _acclaim(folder: Path) -> Path:
    """The known motion on bones of their own axes, in inches of 0.45: CMU's way. Spread legs, as theirs are."""
    names = _names(
        {
            "pelvis": "root",
            "spine1": "lowerback",
            "spine2": "upperback",
            "spine3": "thorax",
            "neck": "lowerneck",
            "head": "head",
            "*_collar": "*clavicle",
            "*_shoulder": "*humerus",
            "*_elbow": "*radius",
            "*_wrist": "*wrist",
            "*_hip": "*femur",
            "*_knee": "*tibia",
            "*_ankle": "*foot",
            "*_foot": "*toes",
            "*_hand": "*hand",
        },
        ("l", "r"),
    )
    zero = _zero_pose(A_POSE)
    unit = 0.45 / 0.0254
    rng = np.random.default_rng(0)
    # a joint with several children needs a bone to each of them: rigid ones without freedoms
    lines = [":version 1.10", ":name VICON", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["  order TX TY TZ RX RY RZ", "  axis XYZ", "  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    hierarchy, axes = [":hierarchy", "  begin"], {"root": np.eye(3)}
    ends = {child: parent for child, parent in enumerate(SMPL_PARENTS) if child}
    bone_of = {0: "root"}
    for child, parent in ends.items():
        offset = unit * zero[parent] @ (SKELETON.rest_joints[child] - SKELETON.rest_joints[parent])
        link = f"link{child}"
        length = np.linalg.norm(offset)
        x, y, z = offset / length
        lines += ["  begin", f"     id {child}", f"     name {link}", f"     direction {x:.9f} {y:.9f} {z:.9f}"]
        lines += [f"     length {length:.9f}", "     axis 0 0 0  XYZ", "  end"]
        name = names[SMPL_NAMES[child]]
        turn = rng.uniform(-90, 90, 3)
        axes[name] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        lines += ["  begin", f"     id {100 + child}", f"     name {name}", "     direction 0 1 0", "     length 0"]
        lines += [f"     axis {turn[0]:.9f} {turn[1]:.9f} {turn[2]:.9f}  XYZ", "    dof rx ry rz"]
        lines += ["    limits (-160.0 20.0)", "           (-70.0 70.0)", "           (-60.0 70.0)", "  end"]
        hierarchy += [f"    {bone_of[parent]} {link}", f"    {link} {name}"]
        bone_of[child] = name
    (folder / "02.asf").write_text("\n".join([*lines, *hierarchy, "  end"]) + "\n")

    world = np.empty((FRAMES, 24, 3, 3))
    motion = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for joint, parent in enumerate(SMPL_PARENTS):
        world[:, joint] = MATRICES[:, joint] if joint == 0 else world[:, parent] @ MATRICES[:, joint]
    turned = world @ np.swapaxes(zero, -1, -2)
    for frame in range(FRAMES):
        motion.append(str(frame + 1))
        for joint, parent in enumerate(SMPL_PARENTS):
            local = turned[frame, joint] if joint == 0 else turned[frame, parent].T @ turned[frame, joint]
            name = bone_of[joint]
            own = axes[name].T @ local @ axes[name]
            numbers = Rotation.from_matrix(own).as_euler("xyz", degrees=True)  # fixed axes, x first
            place = unit * PELVIS[frame] if joint == 0 else []
            motion.append(" ".join([name, *(f"{number:.8f}" for number in [*place, *numbers])]))
    (folder / "02_01.amc").write_text("\n".join(motion) + "\n")
    return folder / "02_01.amc"


def test_acclaim_is_the_same_motion(tmp_path):
    motion = load_motion(_acclaim(tmp_path), SKELETON)
    assert motion.fps == 120 and any("120" in note for note in motion.notes)
    assert_allclose(motion.rotations, MATRICES, atol=TEXT)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)
    assert load_motion(tmp_path / "02_01.amc", SKELETON, fps=60).notes == ()


def test_the_inputs_of_a_motion_are_the_files_that_it_is_read_from(tmp_path):
    file = _acclaim(tmp_path)
    (tmp_path / "03.asf").write_text(":root\n")
    assert motion_inputs(file) == [file, tmp_path / "02.asf"]
    folder = _easymocap_json(tmp_path, frames=range(FRAMES))
    (folder / "out").mkdir()
    for name in ("picture.png", "out/000001.json"):
        (folder / name).write_text("{}")
    assert motion_inputs(folder) == [folder / f"{frame:06d}.json" for frame in range(FRAMES)]
    assert motion_inputs(tmp_path / "walk.npz") == [tmp_path / "walk.npz"]
    with pytest.raises(InputError) as caught:
        motion_inputs(tmp_path / "other" / "run.amc")
    assert str(caught.value) == f"{tmp_path / 'other' / 'run.amc'}: motion not found"


def test_acclaim_bones_keep_their_lengths(tmp_path):
    file = _acclaim(tmp_path)
    skeleton = tmp_path / "02.asf"
    before = skeleton.read_text()
    at = before.index("name lfemur")
    skeleton.write_text(before[:at] + before[at:].replace("dof rx ry rz", "dof rx ry rz l", 1))
    lines = [line + " 1.5" if line.startswith("lfemur ") else line for line in file.read_text().splitlines()]
    file.write_text("\n".join(lines) + "\n")
    assert_allclose(load_motion(file, SKELETON).rotations, MATRICES, atol=TEXT)
    skeleton.write_text(before[:at] + before[at:].replace("dof rx ry rz", "dof rx ry rq", 1))
    with pytest.raises(InputError, match=r"02\.asf: skeleton: .* freedom rq of lfemur"):
        load_motion(file, SKELETON)
    for number in ("nan", "inf"):
        words = before[:at] + before[at:].replace("length 0", f"length {number}", 1)
        skeleton.write_text(words)
        with pytest.raises(InputError, match=r"02\.asf: skeleton: .* not finite: " + number):
            load_motion(file, SKELETON)
    for words, replaced, reason in (
        ("direction 0 1 0", "direction 0 1", "2 numbers of three: 0 1"),
        ("    root link1", "    nobody link1", "link1 that no line of the hierarchy joins to the root"),
    ):
        assert words in before
        skeleton.write_text(before.replace(words, replaced).replace(" name lfemur", " name nobody\n  name lfemur"))
        with pytest.raises(InputError, match=r"02\.asf: skeleton: .*" + reason):
            load_motion(file, SKELETON)


def test_acclaims_numbers_beyond_any_use_are_refused(tmp_path):
    file = _acclaim(tmp_path)
    skeleton, text = tmp_path / "02.asf", file.read_text()
    bone = next(line for line in text.splitlines() if line.startswith("lfemur"))
    file.write_text(text.replace(bone, "lfemur 1e300 0 0", 1))
    with pytest.raises(InputError, match=r"02_01\.amc: frame 0: lfemur: expected numbers of at most 1e\+06, got 1e"):
        load_motion(file, SKELETON)
    file.write_text(text)
    skeleton.write_text(skeleton.read_text().replace("length 0\n", "length 1e300\n", 1))
    with pytest.raises(InputError, match=r"02\.asf: skeleton: expected numbers of at most 1e\+06, got 1e"):
        load_motion(file, SKELETON)


def test_an_acclaim_frame_without_a_bone_of_the_others_is_refused(tmp_path):
    file = _acclaim(tmp_path)
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:-3]) + "\n")
    with pytest.raises(InputError, match=rf"frame {FRAMES - 1}: \w+: expected numbers, as other frames have, got none"):
        load_motion(file, SKELETON)
    file.write_text("\n".join(line for line in lines if not line.startswith(("root", "lhand"))) + "\n")
    notes = load_motion(file, SKELETON).notes
    assert "bones that no frame has stay as the skeleton has them: root, lhand" in notes


def test_acclaim_needs_its_skeleton_and_fitting_bones(tmp_path):
    file = _acclaim(tmp_path)
    skeleton = tmp_path / "02.asf"
    text = file.read_text()
    file.write_text(text.replace("lfemur", "lfemmur"))
    with pytest.raises(InputError, match="lfemmur"):
        load_motion(file, SKELETON)
    bone = next(line for line in text.splitlines() if line.startswith("lfemur"))
    for broken, words in (
        (text.replace(bone, "lfemur nan 0 0", 1), "frame 0: lfemur: expected finite numbers, got not finite: nan 0 0"),
        (text.replace(bone, bone + " 1", 1), "frame 0: lfemur: expected 3 numbers, got 4"),
        (bone + "\n" + text, "AMC motion: expected a frame's number before its bones, got lfemur"),
    ):
        file.write_text(broken)
        with pytest.raises(InputError, match=re.escape(words)):
            load_motion(file, SKELETON)
    file.write_text(text)
    skeleton.rename(tmp_path / "other.asf")
    assert load_motion(file, SKELETON).frame_count == FRAMES  # the only one there
    (tmp_path / "02.ASF").write_text(":root\n")
    assert motion_inputs(file.with_suffix(".AMC"))[1] == tmp_path / "02.ASF"
    (tmp_path / "02.ASF").unlink()
    (tmp_path / "third.asf").write_text(":root\n")
    with pytest.raises(InputError, match=r"02_01\.asf"):
        load_motion(file, SKELETON)
    (tmp_path / "02_01.asf").write_text("hello\n")
    with pytest.raises(InputError, match=r"02_01\.asf"):
        load_motion(file, SKELETON)


# Real files


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


@pytest.mark.parametrize("protocol", [2, 5])
def test_a_pickle_that_is_cut_short_is_refused_wherever_it_is_cut(tmp_path, protocol) -> None:
    content = {"smpl_poses": _flat(POSES)[:2], "smpl_trans": PELVIS[:2], "smpl_scaling": np.ones(1)}
    whole = _pickle(tmp_path / "whole.pkl", content, protocol).read_bytes()
    cut = tmp_path / "cut.pkl"
    for length in range(len(whole) - 1):
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError):
            load_motion(cut, SKELETON)
