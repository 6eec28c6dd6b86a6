"""Body poses of all supported pose estimators give the same person in camera axes."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPLX_REST_ROOT
from rnd_trainer.importing.images import list_files
from rnd_trainer.importing.pose_files import read_poses
from rnd_trainer.importing.poses import Poses, easymocap_poses, smpl_poses, with_convention
from rnd_trainer.importing.scene import _match_joints
from support import layouts
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, axis_angles, shaped_body
from support.pose_programs import (
    FOCALS,
    PROGRAMS,
    write_easymocap_folder,
    write_gvhmr,
    write_phalp,
    write_poses,
    write_romp,
    write_wham,
)

ATOL = 2e-5  # m: float32 in the files and in bone transforms


# A small reference implementation of each convention


def smpl_vertices(body: Body, poses, trans) -> np.ndarray:
    """SMPL: the root rotates about J0, then everything moves by trans; ``poses`` [24, 3] axis-angle."""
    return posed_vertices(body, axis_angle_to_matrix(poses), np.asarray(trans))


def easymocap_vertices(body: Body, poses, Rh, Th) -> np.ndarray:
    """EasyMocap: the body with an unrotated root, rotated by R(Rh) about the origin, moved by Th."""
    plain = np.asarray(poses).copy()
    plain[0] = 0
    return posed_vertices(body, axis_angle_to_matrix(plain), np.zeros(3)) @ axis_angle_to_matrix(Rh).T + Th


def _vertices(poses: Poses, k: int) -> np.ndarray:
    body = shaped_body()
    rest = body.skeleton.rest_joints[0]
    return posed_vertices(body, poses.rotations[k], poses.root(rest)[k] - rest)


def test_root_conventions_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(0)
    angles, Rh, shift = axis_angles(), rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 3))
    plain = angles.copy()
    plain[:, 0] = 0
    easymocap, smpl = easymocap_poses(range(FRAMES), plain, Rh, shift), smpl_poses(range(FRAMES), angles, shift)
    for k in range(FRAMES):
        expected = easymocap_vertices(shaped_body(), angles[k], Rh[k], shift[k])
        assert_allclose(_vertices(easymocap, k), expected, atol=ATOL)
        assert_allclose(_vertices(smpl, k), smpl_vertices(shaped_body(), angles[k], shift[k]), atol=ATOL)


@pytest.mark.parametrize("program", PROGRAMS)
def test_poses_of_each_program_agree_in_camera_axes(tmp_path, program) -> None:
    found = read_poses(PROGRAMS[program](tmp_path))
    assert found.poses.frames.tolist() == list(range(FRAMES))
    focal = float(found.K[0, 0]) if found.focal is None else found.focal(WIDTH, HEIGHT)
    assert focal == pytest.approx(FOCALS[program.split(",")[0]], rel=1e-6)
    world, poses = layouts.camera_world(), found.poses
    smplx = program == "gvhmr"
    assert poses.family == ("SMPL-X" if smplx else "SMPL")
    assert_allclose(poses.root(SMPLX_REST_ROOT if smplx else world.rest), world.positions, atol=ATOL)
    expected = axis_angle_to_matrix(world.thetas.reshape(FRAMES, 24, 3)[:, : 22 if smplx else 24])
    assert_allclose(poses.rotations, expected, atol=1e-6)
    assert_allclose(poses.betas, BETAS, atol=1e-6)


@pytest.mark.parametrize("program", ["phalp", "romp", "wham"])
def test_assumed_focal_lengths_depend_on_the_longer_side(tmp_path, program) -> None:
    broad, low = 64, 48  # pixels of a landscape image; the scene's are portraits
    expected = {"phalp": 5000 * broad / 256, "romp": broad / 2 / np.tan(np.radians(30)), "wham": np.hypot(broad, low)}
    assert read_poses(PROGRAMS[program](tmp_path)).focal(broad, low) == pytest.approx(expected[program])


def test_easymocaps_files_agree_in_the_world(tmp_path) -> None:
    world, folder = layouts.camera_world(), write_easymocap_folder(tmp_path)
    found = read_poses(folder)
    assert found.K is None and found.focal is None and found.numbered
    assert "number 3 taken" in " ".join(found.notes)
    assert found.poses.frames.tolist() == list(range(FRAMES)) and found.poses.convention == "easymocap"
    assert_allclose(found.poses.root(world.rest), world.positions, atol=1e-9)
    assert_allclose(found.poses.rotations, axis_angle_to_matrix(world.thetas.reshape(FRAMES, 24, 3)), atol=1e-9)
    assert_allclose(found.poses.betas, BETAS)
    assert_allclose(read_poses(folder, person=1).poses.root(np.zeros(3)), [[0, 0, 9]])


@pytest.mark.parametrize("write", [write_romp, write_easymocap_folder])
def test_files_are_numbered_where_each_has_a_number(tmp_path, write) -> None:
    folder = write(tmp_path)
    assert read_poses(folder).numbered
    for name, file in zip("abcd", sorted(folder.iterdir())):
        file.rename(folder / f"{name}{file.suffix}")
    found = read_poses(folder)
    assert not found.numbered and found.poses.frames.tolist() == list(range(FRAMES))


@pytest.mark.parametrize("number", [2**63, 10**30])
def test_numbers_of_frames_and_people_may_be_beyond_64_bits(tmp_path, number) -> None:
    folder = write_easymocap_folder(tmp_path)
    for file in folder.iterdir():
        file.write_text(file.read_text().replace('"id": 3', f'"id": {number}'))
    assert len(read_poses(folder, person=number).poses.frames) == FRAMES
    shutil.rmtree(folder)
    with pytest.raises(InputError, match=r"numbers of frames or people: expected below 2\^63"):
        read_poses(write_easymocap_folder(tmp_path, range(number, number + FRAMES)))


def test_romps_files_are_sorted_by_number(tmp_path) -> None:
    """By name, frame_10 comes before frame_9."""
    folder, world = write_romp(tmp_path), layouts.camera_world()
    numbers = [1, 9, 10, 11]
    for number, file in zip(numbers, sorted(folder.iterdir())):
        file.rename(folder / f"frame_{number}.npz")
    poses = read_poses(folder).poses
    assert poses.frames.tolist() == numbers
    assert_allclose(poses.root(world.rest), world.positions, atol=ATOL)
    np.savez(folder / "again_9.npz", **np.load(folder / "frame_9.npz", allow_pickle=True))
    with pytest.raises(InputError, match="romp: body poses: expected frames that ascend, got 9 after 9"):
        read_poses(folder)


def test_romps_results_of_a_video_may_be_beside_those_of_its_frames(tmp_path) -> None:
    """As ROMP leaves them; alone, their image names count by number, too."""
    folder, world = write_romp(tmp_path), layouts.camera_world()
    rows = [np.load(file, allow_pickle=True)["results"].item() for file in sorted(folder.iterdir())]
    results = np.array({f"{k + 8}.jpg": row for k, row in enumerate(rows)}, dtype=object)
    np.savez(folder / "video_results.npz", results=results)
    for path in (folder, folder / "video_results.npz"):
        poses = read_poses(path).poses
        assert poses.frames.tolist() == list(range(FRAMES))
        assert_allclose(poses.root(world.rest), world.positions, atol=ATOL)


def test_a_romp_frame_without_people_is_left_out(tmp_path) -> None:
    folder = write_romp(tmp_path)
    np.savez(folder / f"{1:08d}.npz", results=None)
    assert read_poses(folder).poses.frames.tolist() == [0, 2, 3]
    with pytest.raises(InputError, match="smpl_thetas of at least one frame, got none"):
        read_poses(folder / f"{1:08d}.npz")


def test_a_track_is_chosen_by_number(tmp_path) -> None:
    path = write_wham(tmp_path)
    assert len(read_poses(path, person=0).poses.frames) == 1
    assert "--person chooses another" in " ".join(read_poses(path).notes)
    with pytest.raises(InputError, match="--person: expected 0 or 1, got 7"):
        read_poses(path, person=7)
    for write in (write_gvhmr, write_romp):
        with pytest.raises(InputError, match=r"--person: expected none, .*, got 3"):
            read_poses(write(tmp_path), person=3)


def test_an_npz_is_read_by_its_keys_or_the_given_root(tmp_path) -> None:
    world = layouts.World(layouts.Z_UP)
    np.savez(tmp_path / "smpl.npz", thetas=world.thetas, transl=world.trans, betas=BETAS)
    np.savez(tmp_path / "em.npz", poses=world.thetas, trans=world.Th, betas=BETAS)  # Rh, Th under SMPL's names
    assert_allclose(read_poses(tmp_path / "smpl.npz").poses.root(world.rest), world.positions, atol=1e-9)
    as_smpl = read_poses(tmp_path / "em.npz").poses
    assert np.abs(as_smpl.root(world.rest) - world.positions).max() > 0.1
    poses = with_convention(as_smpl, "easymocap")
    assert_allclose(poses.root(world.rest), world.positions, atol=1e-9)
    assert_allclose(poses.rotations[:, 0], world.roots, atol=1e-9)


def test_joints_that_an_npz_names_are_matched_by_name(tmp_path) -> None:
    """In any order after the root, with SMPL's root or EasyMocap's."""
    world, order = layouts.World(layouts.Z_UP), [0, *range(23, 0, -1)]
    poses = world.thetas.reshape(FRAMES, 24, 3)[:, order].reshape(FRAMES, -1)
    names, file = np.array(SMPL_NAMES)[order], tmp_path / "p.npz"
    for more in ({}, {"Rh": np.zeros((FRAMES, 3))}):
        np.savez(file, poses=poses, trans=world.trans, joint_names=names, **more)
        rotations = _match_joints(read_poses(file).poses, shaped_body())
        assert_allclose(rotations, axis_angle_to_matrix(world.thetas.reshape(-1, 24, 3)))
    np.savez(file, poses=poses, trans=world.trans, joint_names=names[:23])
    with pytest.raises(InputError, match=r"p\.npz: .*expected 23 joints"):
        read_poses(file)


@pytest.mark.parametrize(
    ("more", "family"),
    [
        ({}, "SMPL"),
        ({"jaw_pose": np.zeros((FRAMES, 3))}, "SMPL-X"),
        ({"surface_model_type": "smplx"}, "SMPL-X"),
        ({"surface_model_type": "smplh", "expression": np.zeros(10)}, "SMPL"),
    ],
)
def test_smplx_is_recognised_by_its_members(tmp_path, more, family) -> None:
    thetas = layouts.camera_world().thetas
    np.savez(tmp_path / "p.npz", global_orient=thetas[:, :3], body_pose=thetas[:, 3:66], betas=BETAS, **more)
    poses = read_poses(tmp_path / "p.npz").poses
    assert poses.family == family and len(poses.joint_names) == 22


@pytest.mark.parametrize(("gender", "noted"), [("female", True), (b"male", True), ("neutral", False), (None, False)])
def test_a_shape_of_another_body_is_noted(tmp_path, gender, noted) -> None:
    notes = read_poses(write_poses(tmp_path, gender=gender)).notes
    assert any("give that as --body" in note for note in notes) is noted


def test_phalps_lost_tracks_and_other_entries_are_left_out(tmp_path) -> None:
    """A lost track repeats its last detection, ``tracked_time`` frames old."""
    joblib, path = pytest.importorskip("joblib"), write_phalp(tmp_path)
    content = {"version": "1.0", **joblib.load(path)}
    moments = list(content.values())[1:]
    joblib.dump(content, path)
    assert read_poses(path).poses.frames.tolist() == list(range(FRAMES))
    assert load_motion(path, shaped_body().skeleton).frame_count == FRAMES
    for moment in moments:
        moment["tracked_time"] = [0] * len(moment["tid"])
    moments[2]["tracked_time"] = [1]
    joblib.dump(content, path)
    assert read_poses(path).poses.frames.tolist() == [0, 1, 3]
    for moment in moments[:2]:
        moment["tracked_time"][-1] = 5
    joblib.dump(content, path)
    found = read_poses(path)
    assert found.poses.frames.tolist() == [1, 3] and "number 2 taken" in " ".join(found.notes)
    moments[0]["time"] = float("inf")
    joblib.dump(content, path)
    with pytest.raises(InputError, match=r"phalp_me\.pkl: body poses: expected the layout its keys promise"):
        read_poses(path)


def test_the_first_of_whams_repeated_frames_is_used(tmp_path) -> None:
    track = {"pose": np.zeros((4, 72)), "trans": np.arange(12.0).reshape(4, 3), "betas": np.zeros((4, 10))}
    layouts.write_pickle(tmp_path / "a.pkl", {0: track | {"frame_ids": [7, 5, 7, 6]}})
    poses = read_poses(tmp_path / "a.pkl").poses
    assert poses.frames.tolist() == [5, 6, 7] and poses.root(np.zeros(3))[:, 0].tolist() == [3, 9, 0]
    layouts.write_pickle(tmp_path / "b.pkl", {0: track | {"frame_ids": [7, 5, 6]}})
    with pytest.raises(InputError, match=r"b\.pkl: poses of a track: expected one a frame, got 4 and 3 frame_ids"):
        read_poses(tmp_path / "b.pkl")


REFUSED = {
    # shapes of members, what the refusal names
    "trans": ({"poses": (10, 72), "trans": (9, 3)}, "trans: expected 10 × 3"),
    "flat": ({"poses": (10, 72), "transl": (31,)}, "transl: expected 10 × 3"),
    "Rh": ({"poses": (10, 72), "Rh": (9, 3), "Th": (10, 3)}, "Rh: expected 10 × 3"),
    "all": ({"poses_all": (10, 72), "Rh_all": (10, 3), "Th_all": (9, 3)}, "Th_all: expected 10 × 3"),
    "root": ({"body_pose": (10, 69), "global_orient": (9, 3)}, "global_orient: expected 10 × 3"),
    "columns": ({"poses": (10, 71)}, "joints of the body poses: expected 22, 24, 52, 55"),
    "none": ({"poses": (0, 72)}, "poses: expected a row of numbers a frame"),
    "rate": ({"poses": (10, 72), "mocap_framerate": ()}, "mocap_framerate: expected frames per second"),
    "another": ({"images": (3,)}, "body poses: expected poses, thetas or body_pose"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_npz_of_other_members_is_refused_by_name(tmp_path, name) -> None:
    shapes, words = REFUSED[name]
    np.savez(tmp_path / "p.npz", **{member: np.zeros(shape) for member, shape in shapes.items()})
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "p.npz")
    assert str(caught.value).startswith(f"{tmp_path / 'p.npz'}: {words}")


def test_a_pickle_of_another_program_is_refused_by_name(tmp_path) -> None:
    layouts.write_pickle(tmp_path / "c.pkl", {"nothing": 1})
    with pytest.raises(InputError, match=r"c\.pkl.*WHAM"):
        read_poses(tmp_path / "c.pkl")


def test_poses_check_order_root_and_numbers() -> None:
    for frames in ([0, 2, 1], [0, 1, 1]):
        with pytest.raises(InputError, match="body poses: expected frames that ascend"):
            smpl_poses(frames, np.zeros((3, 72)), np.zeros((3, 3)))
    rotations = np.tile(np.eye(3), (10, 24, 1, 1))
    with pytest.raises(InputError, match="positions of the root: expected 10 × 3, got 9 × 3"):
        Poses(np.arange(10), rotations, lambda rest: np.zeros((9, 3)))
    holed = np.where(np.arange(10)[:, None] == 4, np.nan, np.zeros((10, 3)))
    with pytest.raises(InputError, match="frame 4: body poses: expected finite numbers"):
        Poses(np.arange(10), rotations, lambda rest: holed)


def test_files_are_listed_by_the_numbers_in_their_names(tmp_path) -> None:
    names = ["00009.png", "00010.png", "a.png", "a1.png", "a2b7.png", "a2b10.png", "a10.png", "b.png"]
    for name in names:
        (tmp_path / name).touch()
    assert [file.name for file in list_files(tmp_path)] == names
