"""One known motion in the layouts of arrays, pickles and folders: all read as the same motion."""

import json
import pickle  # noqa: TID251  # to write what others write

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion
from support.known_motion import (
    DOUBLE,
    FRAMES,
    LAYOUTS,
    MATRICES,
    PELVIS,
    POSES,
    SINGLE,
    SKELETON,
    flat,
    write_easymocap,
    write_phalp,
    write_pickle,
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
    track["frame_ids"] = track["frame_ids"][1:]
    with pytest.raises(InputError, match=rf"wham_output.pkl: poses of a track: .* got {FRAMES + 1} and {FRAMES}"):
        load_motion(write_pickle(file, {3: track}), SKELETON)


@pytest.mark.parametrize("write", [write_phalp, write_wham_in_camera])
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
