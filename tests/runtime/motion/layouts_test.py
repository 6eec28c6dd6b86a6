"""One known motion in the layouts of arrays, pickles and folders: all read as the same motion."""

import json
import pickle  # noqa: TID251  # to write what others write
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.smpl import SMPL_REST_ROOT
from rnd_runtime.motion.standing import UP_ROTATIONS
from support.known_motion import (
    DOUBLE,
    FRAMES,
    LAYOUTS,
    MATRICES,
    PELVIS,
    POSES,
    SINGLE,
    SKELETON,
    TILTED,
    flat,
    write_easymocap,
    write_phalp,
    write_pickle,
    write_slahmr,
    write_tram,
    write_vibe,
    write_wham,
    write_wham_in_camera,
)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_the_same_motion(tmp_path, layout):
    write, fps, tolerance = LAYOUTS[layout]
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == fps
    assert_allclose(motion.rotations, MATRICES, atol=tolerance)
    assert_allclose(motion.translations + SKELETON.rest_joints[0], PELVIS, atol=tolerance)


def test_wham_takes_the_longest_track_and_fills_its_gaps(tmp_path):
    file = write_wham(tmp_path)
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
    motion = load_motion(write_pickle(file, people), SKELETON)
    assert motion.frame_count == 25
    angles = Rotation.from_matrix(motion.rotations[:7, 0]).as_rotvec()[:, 0]
    assert_allclose(angles, np.linspace(0, 0.6, 7), atol=DOUBLE)
    notes = " ".join(motion.notes)
    assert "person 5" in notes and "left out: 0, 3, 9" in notes and "5 frames" in notes and "frame rate" in notes


def test_of_whams_repeated_frames_the_first_counts_as_for_rnd_data_import(tmp_path):
    file = write_wham(tmp_path)
    people = pickle.loads(file.read_bytes())
    track = {name: np.concatenate([value[3:], value[:4] * 2]) for name, value in people[3].items()}
    track["frame_ids"] = np.concatenate([people[3]["frame_ids"][3:], people[3]["frame_ids"][:4]])
    motion = load_motion(write_pickle(file, {3: track}), SKELETON)
    assert_allclose(motion.rotations[3:], MATRICES[3:], atol=SINGLE)
    assert motion.frame_count == FRAMES and not np.allclose(motion.rotations[2], MATRICES[2], atol=0.01)
    assert "frame numbers are out of order: sorted; of repeated ones the first counts" in motion.notes
    track["frame_ids"] = track["frame_ids"][1:]
    with pytest.raises(InputError, match=rf"wham_output.pkl: poses of a track: .* got {FRAMES + 1} and {FRAMES}"):
        load_motion(write_pickle(file, {3: track}), SKELETON)


@pytest.mark.parametrize("number", [np.nan, 2**63, 2.0**70, "0001.jpg"])
def test_frame_numbers_that_are_none_are_refused(tmp_path, number):
    file = write_wham(tmp_path)
    track = pickle.loads(file.read_bytes())[3]
    track["frame_ids"] = [*track["frame_ids"][:-1], number]
    with pytest.raises(InputError, match=r"wham_output.pkl: frame numbers: expected whole numbers below 1e\+15, got"):
        load_motion(write_pickle(file, {3: track}), SKELETON)


@pytest.mark.parametrize("write", [write_phalp, write_wham_in_camera, write_tram])
def test_what_a_camera_saw_is_turned_upright_over_the_origin(tmp_path, write):
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == 30 and any("taken to stand level" in note for note in motion.notes)
    assert_allclose(motion.rotations, MATRICES, atol=SINGLE)
    path = motion.translations + SKELETON.rest_joints[0]
    assert_allclose(path, PELVIS - PELVIS[0] * [1, 0, 1], atol=SINGLE)


@pytest.mark.parametrize("write", [write_phalp, write_easymocap])
def test_gaps_are_filled_and_others_named(tmp_path, write):
    frames = [0, 1, *range(4, FRAMES + 2)]
    motion = load_motion(write(tmp_path, frames), SKELETON)
    assert motion.frame_count == FRAMES + 2
    assert_allclose(motion.rotations[4:], MATRICES[2:], atol=SINGLE)
    steps = np.diff(motion.translations[1:5], axis=0)
    assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=SINGLE)
    notes = " ".join(motion.notes)
    assert "2 frames without the person" in notes and "left out: " in notes and "frame rate" in notes


@pytest.mark.parametrize("write", [write_phalp, write_easymocap])
def test_numbers_that_leave_out_hours_are_refused(tmp_path, write):
    with pytest.raises(InputError, match="frame numbers: expected at most 18000 left out, got 9999"):
        load_motion(write(tmp_path, [*range(FRAMES - 1), 99_999_999]), SKELETON)


@pytest.mark.parametrize(("first", "said"), [([0, 0], "0 after 0"), ([0, 1, 1, 5], "1 after 1")])
def test_pictures_of_the_same_time_are_refused(tmp_path, first, said):
    path = write_phalp(tmp_path)
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
        load_motion(write_pickle(tmp_path / "a.pkl", content), SKELETON)
    assert "a.pkl" in str(caught.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scaling", [0.0, -1.0, np.nan])
def test_an_aist_scaling_that_is_none_is_refused(tmp_path, scaling):
    content = {"smpl_poses": flat(POSES), "smpl_trans": PELVIS, "smpl_scaling": np.array([scaling])}
    with pytest.raises(InputError, match=r"a\.pkl: smpl_scaling: expected 1e-06 to 1e\+06, got"):
        load_motion(write_pickle(tmp_path / "a.pkl", content), SKELETON)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("second", [[0, 0, 0], [2, 0, 0]], ids=["zero", "parallel"])
def test_two_rows_that_are_no_rotation_are_refused(tmp_path, second):
    thetas = MATRICES[..., :2, :].reshape(FRAMES, 24, 6).transpose(1, 2, 0).copy()
    thetas[5, :, 2] = [1, 0, 0, *second]
    with pytest.raises(InputError, match=r"a\.pkl: frame 2: thetas: expected two rows of a rotation"):
        load_motion(write_pickle(tmp_path / "a.pkl", {"thetas": thetas, "root_translation": PELVIS.T}), SKELETON)


def test_without_positions_a_person_stands_upright_in_place(tmp_path):
    """VIBE's, TCMR's and MAED's."""
    motion = load_motion(write_vibe(tmp_path), SKELETON)
    assert_allclose(motion.rotations, MATRICES, atol=SINGLE)
    assert (motion.translations == 0).all()
    assert "no trans in the file: the root stays in place" in motion.notes


def test_slahmrs_world_is_turned_by_its_floor(tmp_path):
    """Its world is the first camera's; the floor's normal says what is up there, in either direction."""
    motion = load_motion(write_slahmr(tmp_path, TILTED), SKELETON)
    assert "person 1 is taken, who is seen longest; left out: 0" in motion.notes
    heading = motion.rotations[0, 0] @ MATRICES[0, 0].T
    assert_allclose(heading @ [0, 1, 0], [0, 1, 0], atol=DOUBLE)  # what the floor does not say
    assert_allclose(motion.rotations[:, 0], heading @ MATRICES[:, 0], atol=DOUBLE)
    assert_allclose(motion.rotations[:, 1:], MATRICES[:, 1:], atol=DOUBLE)
    assert_allclose(motion.translations + SKELETON.rest_joints[0], PELVIS @ heading.T, atol=DOUBLE)


CASES = Path(__file__).parents[2] / "cases/formats"
WALKS = ("vibe_output.pkl", "hps_track_0.npy", "prompthmr.pkl", "rotmats.npz", "slahmr_world_results.npz")


@pytest.mark.parametrize("name", [*WALKS, "motionx.npy", "y_up_165.npz"])
def test_the_walk_of_other_programs_stands_and_walks(name):
    motion = load_motion(CASES / name, SKELETON)
    assert_allclose(motion.rotations[:, 0], np.tile(np.eye(3), (40, 1, 1)), atol=SINGLE)
    step = motion.translations[-1] - motion.translations[0]
    walked = {"vibe_output.pkl": 0, "hps_track_0.npy": -0.65}.get(name, 0.65)  # in place; away from the camera
    assert_allclose(step, [0, 0, walked], atol=0.011)
    same = load_motion(CASES / "rotmats.npz", SKELETON).rotations[:, 1:22]
    assert_allclose(motion.rotations[:, 1:22], same, atol=SINGLE)
    assert ("y is taken for up" in " ".join(motion.notes)) == (name == "y_up_165.npz")


@pytest.mark.parametrize("name", ["joints.npy", "mdm_results.npy"])
def test_positions_of_nobody_are_refused_with_their_shape(name):
    with pytest.raises(InputError, match=rf"{name}: joint positions: .* 40×22×3 positions of joints without rotations"):
        load_motion(CASES / name, SKELETON)


@pytest.mark.parametrize("up", ["y", "-y", "z", "-z", "x"])
def test_the_trunk_says_what_is_up(tmp_path, up):
    """Whatever the layout has up: AMASS' here."""
    world = UP_ROTATIONS[up].T
    root = Rotation.from_matrix(world) * Rotation.from_rotvec(POSES[:, 0])
    poses = np.zeros((FRAMES, 52, 3))
    poses[:, :22], poses[:, 0] = POSES[:, :22], root.as_rotvec()
    np.savez(tmp_path / "a.npz", poses=flat(poses), trans=PELVIS @ world.T - SMPL_REST_ROOT, fps=30)
    motion = load_motion(tmp_path / "a.npz", SKELETON)
    assert_allclose(motion.rotations, MATRICES, atol=DOUBLE)
    assert_allclose(motion.translations + SKELETON.rest_joints[0], PELVIS, atol=DOUBLE)
    notes = [note for note in motion.notes if "taken for up" in note]
    expected = f"{up} is taken for up, as the trunk stands along it; --motion-up z overrules"
    assert notes == ([] if up == "z" else [expected])


def test_who_lies_stays_lying(tmp_path):
    """AMASS, along Y and 0.15 m above the floor; a file that states its axis is believed."""
    poses, trans = np.zeros((8, 52, 3)), np.zeros((8, 3))
    trans[:, 2] = 0.15 + np.linspace(0, 0.02, 8)
    np.savez(tmp_path / "a.npz", poses=flat(poses), trans=trans - SMPL_REST_ROOT, fps=30)
    motion = load_motion(tmp_path / "a.npz", SKELETON)
    assert_allclose(motion.rotations[:, 0] @ [0, 1, 0], np.tile([0, 0, -1], (8, 1)), atol=DOUBLE)
    assert "the trunk lies along y, and z stays up, as in its layout; --motion-up y overrules" in motion.notes
    np.savez(tmp_path / "b.npz", poses=flat(poses), trans=trans + np.array([0, 0, 1]), fps=30, up_axis="z")
    assert not any("trunk" in note for note in load_motion(tmp_path / "b.npz", SKELETON).notes)


@pytest.mark.parametrize(
    ("suffix", "words"),
    [("fbx", "Blender"), ("c3d", "markers"), ("trc", "markers"), ("mvnx", "MVN Analyze"), ("usdc", "Blender")],
)
def test_formats_that_are_not_read_name_the_way(tmp_path, suffix, words):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"anything")
    with pytest.raises(InputError, match=rf"a\.{suffix}: motion: expected .* got a \.{suffix} file \(.*{words}"):
        load_motion(path, SKELETON)


@pytest.mark.parametrize("shape", [(4, 60), (4, 30, 3), (3,), (4, 22, 2), ()])
def test_other_arrays_are_refused_with_their_shape(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    got = "×".join(map(str, shape)) or "a single number"
    with pytest.raises(InputError, match=rf"a\.npy: motion as one array: expected F×322 .*, got {got}"):
        load_motion(tmp_path / "a.npy", SKELETON)


def test_matrices_that_are_no_rotations_are_refused_with_their_frame(tmp_path):
    matrices = MATRICES.copy()
    matrices[3, 5] *= 2
    np.savez(tmp_path / "a.npz", poses=matrices, trans=PELVIS, fps=30)
    with pytest.raises(InputError, match=r"a\.npz: frame 3: poses: joint 5: expected rotation matrices, got others"):
        load_motion(tmp_path / "a.npz", SKELETON)
