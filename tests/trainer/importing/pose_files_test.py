"""Body poses of a video, from every program that estimates them, put the same person before the camera."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.readers.arrays import SMPLX_REST_ROOT
from rnd_runtime.motion.skeleton import SMPL_NAMES
from rnd_trainer.checking.check import check_capture
from rnd_trainer.checking.silhouette import overlap
from rnd_trainer.importing.images import listed
from rnd_trainer.importing.importer import find_layout, import_source
from rnd_trainer.importing.layouts import easymocap, nerfstudio
from rnd_trainer.importing.options import ImportOptions
from rnd_trainer.importing.pose_files import read_poses
from rnd_trainer.importing.recording import Poses, easymocap_poses, read_as, smpl_poses
from rnd_trainer.importing.write import _by_name
from support import layouts
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, axis_angles, motion, shaped_body, view_of

PLACE = 2e-5  # m: float32 in the files and in bone transforms
ROUGH = 0.7  # IoU of a mask made at 48×64 pixels, where limbs are two wide: that it is made, not how good it is
FOCALS = {
    "wham": np.hypot(WIDTH, HEIGHT),
    "phalp": 5000 * HEIGHT / 256,
    "romp": 0.5 * HEIGHT / np.tan(np.radians(30)),
    "gvhmr": 77.0,
}


# A small reference implementation of each convention


def smpl_vertices(body: Body, poses, trans) -> np.ndarray:
    """SMPL: the root turns about J0, then everything is moved by trans; ``poses`` [24, 3] axis-angle."""
    return posed_vertices(body, axis_angle_to_matrix(poses), np.asarray(trans))


def easymocap_vertices(body: Body, poses, Rh, Th) -> np.ndarray:
    """EasyMocap: the body with an unturned root, turned by R(Rh) about the origin, moved by Th."""
    unturned = np.asarray(poses).copy()
    unturned[0] = 0
    return posed_vertices(body, axis_angle_to_matrix(unturned), np.zeros(3)) @ axis_angle_to_matrix(Rh).T + Th


def _vertices(poses, k: int) -> np.ndarray:
    body = shaped_body()
    places = poses.root(body.skeleton.rest_joints[0])
    return posed_vertices(body, poses.rotations[k], places[k] - body.skeleton.rest_joints[0])


def test_root_conventions_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(0)
    angles, Rh, shift = axis_angles(), rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 3))
    plain = angles.copy()
    plain[:, 0] = 0
    easymocap, smpl = (easymocap_poses(range(FRAMES), plain, Rh, shift), smpl_poses(range(FRAMES), angles, shift))
    for k in range(FRAMES):
        assert_allclose(
            _vertices(easymocap, k), easymocap_vertices(shaped_body(), angles[k], Rh[k], shift[k]), atol=PLACE
        )
        assert_allclose(_vertices(smpl, k), smpl_vertices(shaped_body(), angles[k], shift[k]), atol=PLACE)


# The programs' files, for the scene seen by its first camera


def _joblib(path: Path, content: object) -> Path:
    joblib = pytest.importorskip("joblib")
    joblib.dump(content, path, compress=3 if "phalp" in path.name else 0)
    return path


def write_wham(folder: Path) -> Path:
    """Two tracks; ours is the longer one."""
    world = layouts.camera_world()
    track = {
        "pose": world.thetas.astype(np.float32),
        "trans": world.trans.astype(np.float32),
        "pose_world": np.ones((FRAMES, 72)),
        "trans_world": np.ones((FRAMES, 3)),
        "betas": np.tile(BETAS, (FRAMES, 1)),
        "verts": np.zeros((FRAMES, 7, 3)),
        "frame_ids": np.arange(FRAMES),
    }
    other = {key: value[:1] for key, value in track.items()}
    return _joblib(folder / "wham_output.pkl", {0: other, 1: track})


def write_gvhmr(folder: Path, rest=SMPLX_REST_ROOT) -> Path:
    """SMPL-X: 21 joints, offsets from SMPL-X's own pelvis ``rest``."""
    torch = pytest.importorskip("torch")
    world = layouts.camera_world()
    incam = {
        "body_pose": world.thetas[:, 3:66],
        "global_orient": world.thetas[:, :3],
        "transl": world.places - rest,
        "betas": np.tile(BETAS, (FRAMES, 1)),
    }
    K = layouts.video_camera(FOCALS["gvhmr"]).K
    content = {
        "smpl_params_incam": {key: torch.tensor(value, dtype=torch.float32) for key, value in incam.items()},
        "smpl_params_global": {key: torch.zeros(FRAMES, 3) for key in incam},
        "K_fullimg": torch.tensor(np.tile(K, (FRAMES, 1, 1)), dtype=torch.float32),
    }
    torch.save(content, folder / "hmr4d_results.pt")
    return folder / "hmr4d_results.pt"


def write_phalp(folder: Path, push: float = 0.0) -> Path:
    """Rotation matrices and a second person in every other picture, before ours; ``push`` m farther away."""
    world = layouts.camera_world()
    world.places = world.places + np.array([0, 0, push])
    content = {}
    for k in range(FRAMES):
        matrices = axis_angle_to_matrix(world.thetas[k].reshape(24, 3)).astype(np.float32)
        ours = {"global_orient": matrices[:1], "body_pose": matrices[1:], "betas": BETAS.astype(np.float32)}
        moment = {"time": k, "tid": [5], "smpl": [ours], "camera": [world.trans[k].astype(np.float32)], "bbox": []}
        if k % 2:
            moment |= {"tid": [2, 5], "smpl": [ours, ours], "camera": [np.ones(3), world.trans[k].astype(np.float32)]}
        content[f"_DEMO/me/img/{k + 1:06d}.jpg"] = moment
    return _joblib(folder / "phalp_me.pkl", content)


def write_romp(folder: Path) -> Path:
    """One results file a frame: a dict inside an array of objects."""
    world = layouts.camera_world()
    (folder / "romp").mkdir()
    for k in range(FRAMES):
        row = {
            "smpl_thetas": world.thetas[k][None].astype(np.float32),
            "smpl_betas": np.append(BETAS, 0)[None].astype(np.float32),
            "cam_trans": world.trans[k][None].astype(np.float32),
            "cam": np.ones((1, 3)),
        }
        np.savez(folder / "romp" / f"{k:08d}.npz", results=np.array(row, dtype=object))
    return folder / "romp"


def write_romp_video(folder: Path) -> Path:
    """A video's results in one file, by picture name; one frame saw nobody."""
    files = sorted(write_romp(folder).iterdir())
    rows = {f"{k:06d}.jpg": np.load(file, allow_pickle=True)["results"].item() for k, file in enumerate(files)}
    np.savez(folder / "video_results.npz", results=np.array(rows | {f"{FRAMES:06d}.jpg": None}, dtype=object))
    return folder / "video_results.npz"


def write_easymocap_folder(folder: Path, numbers: Sequence[int] = range(FRAMES)) -> Path:
    """A file a frame, with somebody else before ours in the first; a camera at the origin of its world."""
    world, path = layouts.camera_world(), folder / "smpl"
    path.mkdir()
    for k, number in enumerate(numbers):
        ours = {
            "id": 3,
            "Rh": [world.Rh[k].tolist()],
            "Th": [world.Th[k].tolist()],
            "poses": [[0.0] * 3 + world.thetas[k, 3:].tolist()],
            "shapes": [BETAS.tolist()],
        }
        people = [ours | {"id": 1, "Th": [[0, 0, 9]]}, ours] if k == 0 else [ours]
        (path / f"{number:06d}.json").write_text(json.dumps({"annots": people} if k % 2 else people))
    return path


PROGRAMS = {
    "wham": write_wham,
    "gvhmr": write_gvhmr,
    "phalp": write_phalp,
    "romp": write_romp,
    "romp, a video": write_romp_video,
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_programs_poses_put_the_person_where_it_saw_it(tmp_path, program) -> None:
    found = read_poses(PROGRAMS[program](tmp_path))
    assert found.poses.frames.tolist() == list(range(FRAMES))
    K = found.K if found.focal is None else None
    focal = float(K[0, 0]) if K is not None else found.focal(WIDTH, HEIGHT)
    assert focal == pytest.approx(FOCALS[program.split(",")[0]], rel=1e-6)
    world, poses = layouts.camera_world(), found.poses
    rest = SMPLX_REST_ROOT if program == "gvhmr" else shaped_body().skeleton.rest_joints[0]
    assert poses.family == ("SMPL-X" if program == "gvhmr" else "SMPL")
    assert_allclose(poses.root(rest), world.places, atol=PLACE)
    joints = 22 if program == "gvhmr" else 24
    expected = axis_angle_to_matrix(world.thetas.reshape(FRAMES, 24, 3)[:, :joints])
    assert_allclose(poses.rotations, expected, atol=1e-6)
    assert_allclose(poses.betas, BETAS, atol=1e-6)


def test_easymocaps_files_put_the_person_where_it_saw_it(tmp_path) -> None:
    world, folder = layouts.camera_world(), write_easymocap_folder(tmp_path)
    found = read_poses(folder)
    assert found.kind == "EasyMocap" and found.K is None and found.focal is None
    assert "number 3 taken" in " ".join(found.notes)
    assert found.poses.frames.tolist() == list(range(FRAMES)) and found.poses.convention == "easymocap"
    assert_allclose(found.poses.root(shaped_body().skeleton.rest_joints[0]), world.places, atol=1e-9)
    assert_allclose(found.poses.rotations, axis_angle_to_matrix(world.thetas.reshape(FRAMES, 24, 3)), atol=1e-9)
    assert_allclose(found.poses.betas, BETAS)
    other = read_poses(folder, person=1).poses
    assert_allclose(other.root(np.zeros(3)), [[0, 0, 9]])


def test_romps_files_are_sorted_by_number(tmp_path) -> None:
    """By name, frame_10 would come before frame_9."""
    folder, world = write_romp(tmp_path), layouts.camera_world()
    numbers = [1, 9, 10, 11]
    for number, file in zip(numbers, sorted(folder.iterdir())):
        file.rename(folder / f"frame_{number}.npz")
    poses = read_poses(folder).poses
    assert poses.frames.tolist() == numbers
    assert_allclose(poses.root(world.rest), world.places, atol=PLACE)
    np.savez(folder / "again_9.npz", **np.load(folder / "frame_9.npz", allow_pickle=True))
    with pytest.raises(InputError, match="romp: body poses: expected frames that ascend, got 9 after 9"):
        read_poses(folder)


def test_romps_results_of_a_video_may_lie_beside_those_of_its_frames(tmp_path) -> None:
    """As ROMP leaves them; by themselves their pictures' names count by number, too."""
    folder, world = write_romp(tmp_path), layouts.camera_world()
    rows = [np.load(file, allow_pickle=True)["results"].item() for file in sorted(folder.iterdir())]
    results = np.array({f"{k + 8}.jpg": row for k, row in enumerate(rows)}, dtype=object)
    np.savez(folder / "video_results.npz", results=results)
    for path in (folder, folder / "video_results.npz"):
        poses = read_poses(path).poses
        assert poses.frames.tolist() == list(range(FRAMES))
        assert_allclose(poses.root(world.rest), world.places, atol=PLACE)


def test_a_frame_in_which_romp_saw_nobody_is_left_out(tmp_path) -> None:
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


@pytest.mark.parametrize("write", [write_gvhmr, write_romp])
def test_people_without_numbers_are_not_chosen_among(tmp_path, write) -> None:
    with pytest.raises(InputError, match=r"--person: expected none, as .* has no numbers of people, got 3"):
        read_poses(write(tmp_path), person=3)


def test_an_npz_is_read_by_its_keys_or_as_told(tmp_path) -> None:
    world = layouts.World(layouts.Z_UP)
    rest = shaped_body().skeleton.rest_joints[0]
    np.savez(tmp_path / "smpl.npz", thetas=world.thetas, transl=world.trans, betas=BETAS)
    np.savez(tmp_path / "em.npz", poses=world.thetas, trans=world.Th, betas=BETAS)  # Rh, Th under SMPL's names
    assert_allclose(read_poses(tmp_path / "smpl.npz").poses.root(rest), world.places, atol=1e-9)
    told = read_as(read_poses(tmp_path / "em.npz").poses, "easymocap")
    assert_allclose(told.root(rest), world.places, atol=1e-9)
    assert_allclose(told.rotations[:, 0], world.roots, atol=1e-9)
    assert np.abs(read_poses(tmp_path / "em.npz").poses.root(rest) - world.places).max() > 0.1


def test_joints_that_an_npz_names_are_told_by_name(tmp_path) -> None:
    """In any order after the root, as rnd-play has it; 24 joints are not SMPL's where they say otherwise."""
    world, order = layouts.World(layouts.Z_UP), [0, *range(23, 0, -1)]
    poses = world.thetas.reshape(FRAMES, 24, 3)[:, order].reshape(FRAMES, -1)
    names, file = np.array(SMPL_NAMES)[order], tmp_path / "p.npz"
    for more in ({}, {"Rh": np.zeros((FRAMES, 3))}):
        np.savez(file, poses=poses, trans=world.trans, joint_names=names, **more)
        named = read_poses(file).poses
        assert_allclose(_by_name(named, shaped_body()), axis_angle_to_matrix(world.thetas.reshape(-1, 24, 3)))
    np.savez(file, poses=poses, trans=world.trans, joint_names=names[:23])
    with pytest.raises(InputError, match=r"p\.npz: joints of the motion: expected 23 joints"):
        read_poses(file)


@pytest.mark.parametrize(
    ("more", "family"),
    [
        ({}, "SMPL"),
        ({"jaw_pose": np.zeros((FRAMES, 3))}, "SMPL-X"),
        ({"expression": np.zeros((FRAMES, 10))}, "SMPL-X"),
        ({"left_hand_pose": np.zeros((FRAMES, 12))}, "SMPL-X"),
        ({"surface_model_type": "smplx"}, "SMPL-X"),
        ({"surface_model_type": "smplh", "expression": np.zeros(10)}, "SMPL"),
    ],
)
def test_members_tell_smplx(tmp_path, more, family) -> None:
    thetas = layouts.camera_world().thetas
    np.savez(tmp_path / "p.npz", global_orient=thetas[:, :3], body_pose=thetas[:, 3:66], betas=BETAS, **more)
    poses = read_poses(tmp_path / "p.npz").poses
    assert poses.family == family and len(poses.joint_names) == 22


@pytest.mark.parametrize(
    ("gender", "betas", "said"),
    [
        ("female", True, "female"),
        (b"male", True, "male"),
        ("neutral", True, ""),
        (None, True, ""),
        ("female", False, ""),
    ],
)
def test_a_shape_of_another_body_is_noted(tmp_path, gender, betas, said) -> None:
    world = layouts.camera_world()
    shape = {"betas": BETAS} if betas else {}
    np.savez(tmp_path / "p.npz", poses=world.thetas, trans=world.trans, gender=gender, **shape)
    notes = read_poses(tmp_path / "p.npz").notes
    assert notes == ((f"the shape is meant for the {said} body model: give that as --body",) if said else ())


def test_what_phalp_notes_beside_its_pictures_is_no_picture(tmp_path) -> None:
    joblib, path = pytest.importorskip("joblib"), write_phalp(tmp_path)
    joblib.dump({"version": "1.0", **joblib.load(path)}, path)
    assert read_poses(path).poses.frames.tolist() == list(range(FRAMES))
    assert load_motion(path, shaped_body().skeleton).frame_count == FRAMES


def test_a_part_of_a_track_that_is_another_thing_is_refused(tmp_path) -> None:
    joblib, path = pytest.importorskip("joblib"), write_phalp(tmp_path)
    content = joblib.load(path)
    next(iter(content.values()))["tracked_time"] = 1
    next(iter(content.values()))["time"] = float("inf")
    joblib.dump(content, path)
    with pytest.raises(InputError, match=r"phalp_me\.pkl: body poses: expected the layout its keys promise"):
        read_poses(path)


@pytest.mark.parametrize("rate", [-30.0, 0.0, 1e9, [30, 30]])
def test_a_rate_at_which_nobody_records_is_refused(tmp_path, rate) -> None:
    world = layouts.camera_world()
    np.savez(tmp_path / "p.npz", thetas=world.thetas, trans=world.trans, mocap_framerate=rate)
    with pytest.raises(InputError, match=r"mocap_framerate: expected frames per second, 0\.001 to 10000, got \["):
        read_poses(tmp_path / "p.npz")


def test_a_track_that_phalp_lost_is_left_out_there(tmp_path) -> None:
    """It repeats the last sight, ``tracked_time`` frames old; a person seen once is no longer than one seen twice."""
    joblib, path = pytest.importorskip("joblib"), write_phalp(tmp_path)
    content = joblib.load(path)
    moments = list(content.values())
    for moment in moments:
        moment["tracked_time"] = [0] * len(moment["tid"])
    moments[2]["tracked_time"] = [1]
    joblib.dump(content, path)
    assert read_poses(path).poses.frames.tolist() == [0, 1, 3]
    for moment in moments[:2]:
        moment["tracked_time"][-1] = 5
    joblib.dump(content, path)
    assert read_poses(path).poses.frames.tolist() == [1, 3] and "number 2 taken" in " ".join(read_poses(path).notes)


def test_of_whams_repeated_frames_the_first_counts(tmp_path) -> None:
    track = {"pose": np.zeros((4, 72)), "trans": np.arange(12.0).reshape(4, 3), "betas": np.zeros((4, 10))}
    layouts._pickle(tmp_path / "a.pkl", {0: track | {"frame_ids": [7, 5, 7, 6]}})
    poses = read_poses(tmp_path / "a.pkl").poses
    assert poses.frames.tolist() == [5, 6, 7] and poses.root(np.zeros(3))[:, 0].tolist() == [3, 9, 0]
    layouts._pickle(tmp_path / "b.pkl", {0: track | {"frame_ids": [7, 5, 6]}})
    with pytest.raises(InputError, match=r"b\.pkl: poses of a track: expected one a frame, got 4 and 3 frame_ids"):
        read_poses(tmp_path / "b.pkl")


def test_files_that_are_no_poses_are_refused_by_name(tmp_path) -> None:
    (tmp_path / "a.json").write_text("{}")
    np.savez(tmp_path / "b.npz", pictures=np.zeros(3))
    with pytest.raises(InputError, match=r"b\.npz.*poses, thetas or body_pose"):
        read_poses(tmp_path / "b.npz")
    layouts._pickle(tmp_path / "c.pkl", {"nothing": 1})
    with pytest.raises(InputError, match=r"c\.pkl.*WHAM"):
        read_poses(tmp_path / "c.pkl")


COUNTS = {
    # members of 10 frames' poses of which one has another count, and what is said
    "trans": ({"poses": (10, 72), "trans": (9, 3)}, "trans: expected 10 × 3, as there are 10 poses, got 9 × 3"),
    "more": ({"poses": (10, 72), "trans": (12, 3)}, "trans: expected 10 × 3, as there are 10 poses, got 12 × 3"),
    "flat": ({"poses": (10, 72), "transl": (31,)}, "transl: expected 10 × 3, as there are 10 poses, got 31"),
    "Rh": ({"poses": (10, 72), "Rh": (9, 3), "Th": (10, 3)}, "Rh: expected 10 × 3, as there are 10 poses, got 9 × 3"),
    "Th": ({"poses": (10, 72), "Rh": (10, 3), "Th": (1, 3)}, "Th: expected 10 × 3, as there are 10 poses, got 1 × 3"),
    "all": (
        {"poses_all": (10, 72), "Rh_all": (10, 3), "Th_all": (9, 3)},
        "Th_all: expected 10 × 3, as there are 10 poses, got 9 × 3",
    ),
    "turn": ({"poses": (10, 72), "Rh_all": (9, 3)}, "Rh_all: expected 10 × 3, as there are 10 poses, got 9 × 3"),
    "root": ({"body_pose": (10, 69), "global_orient": (9, 3)}, "global_orient: expected 10 × 3, as"),
    "columns": ({"poses": (10, 71)}, "joints of the body poses: expected 22, 24, 52, 55, got 10 × 71"),
    "none": ({"poses": (0, 72)}, "poses: expected a row of numbers a frame, got [0, 72]"),
}


@pytest.mark.parametrize("name", COUNTS)
def test_members_of_other_counts_than_the_poses_are_refused(tmp_path, name) -> None:
    shapes, said = COUNTS[name]
    np.savez(tmp_path / "p.npz", **{member: np.zeros(shape) for member, shape in shapes.items()})
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "p.npz")
    assert str(caught.value).startswith(f"{tmp_path / 'p.npz'}: {said}")


@pytest.mark.parametrize(("frames", "said"), [([0, 2, 1], "1 after 2"), ([0, 1, 1], "1 after 1")])
def test_poses_in_no_order_are_refused(frames, said) -> None:
    with pytest.raises(InputError, match=f"body poses: expected frames that ascend, got {said}"):
        smpl_poses(frames, np.zeros((3, 72)), np.zeros((3, 3)))


def test_pictures_are_listed_by_the_numbers_in_their_names(tmp_path) -> None:
    names = ["00009.png", "00010.png", "a.png", "a1.png", "a2b7.png", "a2b10.png", "a10.png", "b.png"]
    for name in names:
        (tmp_path / name).touch()
    assert [file.name for file in listed(tmp_path)] == names


def test_poses_ask_where_the_root_is_once_and_check_it() -> None:
    rotations, asked = np.tile(np.eye(3), (10, 24, 1, 1)), []

    def poses(places: np.ndarray) -> Poses:
        return Poses(np.arange(10), rotations, lambda rest: asked.append(rest) or places + rest)

    poses(np.zeros((10, 3)))
    assert len(asked) == 1
    for count in (1, 9, 12):
        with pytest.raises(InputError, match=rf"places of the root: expected 10 × 3, got {count} × 3"):
            poses(np.zeros((count, 3)))
    with pytest.raises(InputError, match="frame 4: body poses: expected finite numbers"):
        poses(np.where(np.arange(10)[:, None] == 4, np.nan, np.zeros((10, 3))))


# A plain video


def _film(folder: Path, camera: Camera) -> Path:
    """me.mp4: the scene through a centred lens."""
    images = []
    for k in range(FRAMES):
        view = view_of(camera, k)
        colours = to_bytes(0.2 + 0.35 * (view.normals + 1))
        images.append(np.where(view.mask[..., None], colours, 90).astype(np.uint8))
    layouts.write_video(folder / "me.mp4", images, fps=25)
    return folder / "me.mp4"


def _options(folder: Path, **options: object) -> ImportOptions:
    options = options if "poses" in options else {"poses": write_romp(folder)} | options
    return ImportOptions(**({"body": str(layouts.body_file(folder))} | options))


FAR = 52.0  # m: what PHALP's long lens needs to see as much of the person as the others
FILMED = {
    # writer, focal length, metres farther away, the body's writer, what the user has to add
    "wham": (write_wham, FOCALS["wham"], 0.0, layouts.body_file, ()),
    "gvhmr": (
        partial(write_gvhmr, rest=shaped_body().skeleton.rest_joints[0]),
        FOCALS["gvhmr"],
        0.0,
        layouts.smplx_body_file,
        (),
    ),
    "phalp": (partial(write_phalp, push=FAR), FOCALS["phalp"], FAR, layouts.body_file, ()),
    "romp": (write_romp, FOCALS["romp"], 0.0, layouts.body_file, ()),
    "easymocap": (write_easymocap_folder, 77.0, 0.0, layouts.body_file, (77.0, 77.0, WIDTH / 2, HEIGHT / 2)),
}


@pytest.mark.parametrize("program", FILMED)
def test_a_plain_video_becomes_a_capture(tmp_path, program) -> None:
    write, focal, far, write_body, intrinsics = FILMED[program]
    truth = layouts.video_camera(focal)
    truth.world_to_camera[2, 3] += far
    film = _film(tmp_path, truth)
    (tmp_path / "normals").mkdir()
    for k in range(FRAMES):
        view = view_of(truth, k)
        write_image(tmp_path / "masks" / f"{k:05d}.png", (255 * view.mask).astype(np.uint8))
        normals = view.normals * [1, -1, -1]  # right, up, to the viewer
        np.save(tmp_path / "normals" / f"{k:05d}.npy", normals.astype(np.float32))
    assert find_layout(film) == ("video", "a video")
    options = ImportOptions(
        body=str(write_body(tmp_path)),
        poses=write(tmp_path),
        intrinsics=intrinsics,
        masks=tmp_path / "masks",
        normals=tmp_path / "normals",
    )
    scene = import_source(film, tmp_path / "out", options)
    assert any("up, towards the viewer" in note for note in scene.notes)
    capture = load_capture(tmp_path / "out")
    assert capture.fps == 25 and [f.split for f in capture.frames] == ["train"] * 3 + ["novel_pose"]
    for frame in capture.frames:
        camera = capture.cameras["0"]
        assert_allclose(camera.K, truth.K, rtol=1e-6)  # GVHMR stores float32
        theirs = posed_vertices(
            capture.body, capture.motion.rotations[frame.frame], capture.motion.translations[frame.frame]
        )
        ours = posed_vertices(shaped_body(), motion().rotations[frame.frame], motion().translations[frame.frame])
        local, expected = (
            v @ c.world_to_camera[:3, :3].T + c.world_to_camera[:3, 3] for v, c in ((theirs, camera), (ours, truth))
        )
        assert_allclose(local, expected, atol=PLACE)
        images, view = capture.load_frame(frame), view_of(truth, frame.frame)
        assert ((images.mask > 0.5) == view.mask).all()
        known = view.mask & (np.abs(images.normal).max(-1) > 0)
        assert (known == view.mask).all()
        facing = known & (view.normals[..., 2] < 0)  # at the rim, smooth normals may turn away: stored at 90°
        assert (images.normal * view.normals).sum(-1)[facing].min() > 0.999
    report = check_capture(tmp_path / "out")
    assert not report.wrong, report.findings


PAIRED = {
    # number of each picture → pose of the scene, number of each pose file → pose of the scene, pictures kept, noted
    "ffmpeg's, both from 1": ({1: 0, 2: 1, 3: 2, 4: 3}, {1: 0, 2: 1, 3: 2, 4: 3}, 4, ""),
    "pictures taken out": ({1: 0, 2: 1, 4: 3}, {1: 0, 2: 1, 3: 2, 4: 3}, 3, ""),
    "nobody seen in some": ({8: 0, 9: 1, 10: 2, 11: 3}, {9: 1, 11: 3}, 2, ""),
    "each lacks one": ({1: 0, 2: 1, 4: 3}, {2: 1, 3: 2, 4: 3}, 2, ""),
    "poses before the pictures": ({12: 2, 13: 3}, {10: 0, 11: 1, 12: 2, 13: 3}, 2, ""),
    "poses from 0": ({1: 0, 2: 1, 3: 2, 4: 3}, {0: 0, 1: 1, 2: 2, 3: 3}, 4, "from 0, frames from 1"),
    "poses from 0, one missing": ({1: 0, 2: 1, 3: 2, 4: 3}, {0: 0, 2: 2}, 2, "from 0, frames from 1"),
    "pictures from 0": ({0: 0, 1: 1, 2: 2, 3: 3}, {1: 0, 2: 1, 4: 3}, 3, "from 1, frames from 0"),
    "a part, poses from 0": ({51: 0, 52: 1, 53: 2, 54: 3}, {0: 0, 1: 1, 2: 2, 3: 3}, 4, "from 0, frames from 51"),
}


def _pictures(folder: Path, camera: Camera, names: dict[str, int]) -> Path:
    """frames/ and masks/ of the scene's poses, by name."""
    for name, k in names.items():
        view = view_of(camera, k)
        image = np.where(view.mask[..., None], to_bytes(0.2 + 0.35 * (view.normals + 1)), 90)
        write_image(folder / "frames" / f"{name}.png", image.astype(np.uint8))
        write_image(folder / "masks" / f"{name}.png", (255 * view.mask).astype(np.uint8))
    return folder / "frames"


def _fits(folder: Path, numbers: dict[int, int]) -> Path:
    """ROMP's files of the scene's poses, by number."""
    written = write_romp(folder)
    (folder / "fits").mkdir()
    for number, k in numbers.items():
        (folder / "fits" / f"{number:05d}.npz").hardlink_to(written / f"{k:08d}.npz")
    return folder / "fits"


def _assert_together(folder: Path, camera: Camera, pose_of: dict[int, int]) -> None:
    """The capture in ``folder`` shows and poses the scene's poses, by the numbers in its pictures' names."""
    capture = load_capture(folder)
    for frame in capture.frames:
        k = pose_of[int(Path(frame.image).stem.split("_")[1])]
        assert ((capture.load_frame(frame).mask > 0.5) == view_of(camera, k).mask).all()
        posed = posed_vertices(
            capture.body, capture.motion.rotations[frame.frame], capture.motion.translations[frame.frame]
        )
        truth = posed_vertices(shaped_body(), motion().rotations[k], motion().translations[k])
        local, expected = (
            v @ c.world_to_camera[:3, :3].T + c.world_to_camera[:3, 3]
            for v, c in ((posed, capture.cameras["0"]), (truth, camera))
        )
        assert_allclose(local, expected, atol=PLACE)


@pytest.mark.parametrize("name", PAIRED)
def test_numbered_pictures_and_poses_belong_together_by_number(tmp_path, name) -> None:
    pictures, poses, kept, noted = PAIRED[name]
    camera = layouts.video_camera(FOCALS["romp"])
    source = _pictures(tmp_path, camera, {f"f{number}": k for number, k in pictures.items()})
    options = _options(tmp_path, poses=_fits(tmp_path, poses), masks=tmp_path / "masks")
    scene = import_source(source, tmp_path / "out", options)
    notes = [note for note in scene.notes if "taken for the same" in note]
    assert len(notes) == bool(noted) and noted in "".join(notes)
    assert len(load_capture(tmp_path / "out").frames) == kept
    _assert_together(tmp_path / "out", camera, pictures)


WHOLE = {k: k for k in range(FRAMES)}


@pytest.mark.parametrize("write", [write_wham, write_romp_video])
def test_poses_in_one_file_belong_to_the_pictures_in_their_order(tmp_path, write) -> None:
    """Whatever the pictures are numbered from."""
    camera = layouts.video_camera(FOCALS[write.__name__.split("_")[1]])
    source = _pictures(tmp_path, camera, {f"{k + 1:05d}": k for k in range(FRAMES)})
    options = _options(tmp_path, poses=write(tmp_path), masks=tmp_path / "masks")
    import_source(source, tmp_path / "out", options)
    assert len(load_capture(tmp_path / "out").frames) == FRAMES
    _assert_together(tmp_path / "out", camera, WHOLE)


@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("film", [True, False])
def test_numbered_poses_of_frames_without_numbers_belong_to_them_in_their_order(tmp_path, film, start) -> None:
    """Where the last number tells that the first is 1, by that."""
    camera = layouts.video_camera(FOCALS["romp"])
    source = _pictures(tmp_path, camera, {f"f{k}{'' if film else 'x'}": k for k in range(FRAMES)})
    poses = _fits(tmp_path, {k + start: k for k in range(FRAMES)})
    options = _options(tmp_path, poses=poses, masks=tmp_path / "masks")
    scene = import_source(_film(tmp_path, camera) if film else source, tmp_path / "out", options)
    assert any("from 1, frames from 0" in note for note in scene.notes) == bool(start)
    assert len(load_capture(tmp_path / "out").frames) == FRAMES
    _assert_together(tmp_path / "out", camera, WHOLE)


@pytest.mark.parametrize(
    ("count", "fps", "noted"),
    [
        (FRAMES, 25, ""),
        (FRAMES, 25.1, ""),
        (8, 50, "poses end with frame 7, pictures with frame 3"),
        (8, 50, "poses have 50 frames per second, pictures 25"),
        (3, 25, "poses end with frame 2, pictures with frame 3"),
    ],
)
def test_poses_of_another_rate_or_count_than_the_pictures_are_noted(tmp_path, count, fps, noted) -> None:
    camera, world = layouts.video_camera(77.0), layouts.camera_world()
    rows = np.arange(count) % FRAMES
    np.savez(tmp_path / "p.npz", poses=world.thetas[rows], trans=world.trans[rows], betas=BETAS, fps=fps)
    K = (77.0, 77.0, WIDTH / 2, HEIGHT / 2)
    options = _options(tmp_path, poses=tmp_path / "p.npz", intrinsics=K)
    notes = import_source(_film(tmp_path, camera), tmp_path / "out", options).notes
    found = [note for note in notes if "poses end" in note or "per second" in note]
    assert noted in " ".join(found) and bool(found) == bool(noted)


def test_poses_of_other_frames_are_refused(tmp_path) -> None:
    source = _pictures(tmp_path, layouts.video_camera(FOCALS["romp"]), {"f1": 0, "f2": 1, "f3": 2})
    options = _options(tmp_path, poses=_fits(tmp_path, {7: 0, 8: 1}))
    with pytest.raises(InputError, match=r"frames: body poses: expected some of frames 1 … 3, got 7 … 8"):
        import_source(source, tmp_path / "out", options)


def test_numbers_that_count_no_frames_are_refused(tmp_path) -> None:
    """Times, to the microsecond."""
    times = {1767225600000000: 0, 1767225600033333: 1, 1767225600066666: 2, 1767229200000000: 3}
    source = _pictures(tmp_path, layouts.video_camera(FOCALS["romp"]), {str(time): k for time, k in times.items()})
    options = _options(tmp_path, poses=_fits(tmp_path, times))
    with pytest.raises(InputError, match="frames of the poses: expected at most 100000 left out, got 3599999997 "):
        import_source(source, tmp_path / "out", options)


@pytest.mark.parametrize(
    ("numbers", "frames"), [([1, 2, 3, 4], [1, 2, 3, 4]), ([0, 1, 2, 3], [1, 2, 3, 4]), (None, [0, 1, 2, 3])]
)
@pytest.mark.parametrize("moves", [0, 1])
def test_pictures_of_one_camera_belong_to_poses_by_name(tmp_path, moves, numbers, frames) -> None:
    """Of transforms.json, whatever their order there: to poses in numbered files and in one."""
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    for k, entry in zip((2, 1, 4, 3), record["frames"]):
        entry |= {"time_index": None, "file_path": f"f{k}.png"}
        entry["transform_matrix"][0][3] += moves * k
    del record["frames"][FRAMES:]
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    poses = None if numbers is None else write_easymocap_folder(tmp_path, numbers)
    recording = nerfstudio.read(tmp_path, poses=poses)
    assert {shot.name: shot.frame for shot in recording.shots} == dict(zip(("f1", "f2", "f3", "f4"), frames))
    assert recording.poses.frames.tolist() == frames
    assert any("taken for the same" in note for note in recording.notes) == (numbers == [0, 1, 2, 3])


@pytest.mark.parametrize("program", PROGRAMS)
def test_poses_before_a_camera_are_turned_with_it_where_it_is_the_only_one(tmp_path, program) -> None:
    """A camera that moves has a world of another size than the poses."""
    (tmp_path / "source").mkdir()
    layouts.write_nerfstudio(tmp_path / "source")
    file = tmp_path / "source" / "transforms.json"
    record = json.loads(file.read_text())
    poses = PROGRAMS[program](tmp_path)
    with pytest.raises(InputError, match=r"transforms\.json: body poses: expected some in the cameras' world, got .*2"):
        nerfstudio.read(tmp_path / "source", poses=poses)
    file.write_text(json.dumps(record | {"frames": record["frames"][:FRAMES]}))
    theirs = nerfstudio.read(tmp_path / "source", poses=poses).poses
    world = layouts.World(layouts.Z_UP, (0.3, -0.2, 0.1))
    rest = SMPLX_REST_ROOT if program == "gvhmr" else world.rest
    assert_allclose(theirs.root(rest), world.places, atol=PLACE)
    assert_allclose(theirs.rotations[:, 0], world.roots, atol=PLACE)


def test_poses_before_one_of_easymocaps_cameras_are_refused(tmp_path) -> None:
    (tmp_path / "source").mkdir()
    layouts.write_easymocap(tmp_path / "source")
    with pytest.raises(InputError, match="expected some in the cameras' world, got ROMP's"):
        easymocap.read(tmp_path / "source", poses=write_romp(tmp_path))


def test_rows_of_easyvolcaps_motion_belong_to_the_pictures_in_their_order(tmp_path) -> None:
    """Whatever number those begin with; its JSON files have numbers of their own."""
    layouts.write_easymocap(tmp_path, volcap=True)
    for part in ("images", "masks"):
        for file in sorted(tmp_path.glob(f"{part}/*/*"), reverse=True):
            file.rename(file.with_stem(f"{int(file.stem) + 1:06d}"))
    recording = easymocap.read(tmp_path)
    assert {(shot.name, shot.frame) for shot in recording.shots} == {(f"{k + 1:06d}", k) for k in range(FRAMES)}
    assert recording.poses.frames.tolist() == list(range(FRAMES)) and not recording.notes
    numbered = easymocap.read(tmp_path, poses=write_easymocap_folder(tmp_path, [1, 2, 3, 4]))
    assert {shot.frame for shot in numbered.shots} == {1, 2, 3, 4} == set(numbered.poses.frames.tolist())


@pytest.mark.parametrize("name", ["intri.yml", "extri.yml"])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        "%YAML:1.0\n---\nnames: [1, \n",
        "%YAML:1.0\n---\nnames: 3\nK_01: 1\nT_01: 1\n",
        '%YAML:1.0\n---\nnames: ["01"]\n'
        + "".join(f"{key}_01: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1, 2]\n" for key in "KT"),
    ],
)
def test_a_damaged_calibration_is_one_line(tmp_path, name, text) -> None:
    (tmp_path / "source").mkdir()
    layouts.write_easymocap(tmp_path / "source")
    (tmp_path / "source" / name).write_text(text)
    with pytest.raises(InputError, match=r"source.*: (calibration|names).*: expected"):
        import_source(tmp_path / "source", tmp_path / "out", ImportOptions(body=str(layouts.body_file(tmp_path))))


LENSES = {
    "camera_model": ["OPENCV_FISHEYE", "FISHEYE624", "VR180_L", "ORTHOPHOTO", "EQUIRECTANGULAR"],
    "is_fisheye": [True],
    "k4": [0.1],
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key in LENSES for value in LENSES[key]])
@pytest.mark.parametrize("of_all", [True, False])
def test_lenses_that_are_no_pinholes_are_refused(tmp_path, of_all, key, value) -> None:
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    (record if of_all else record["frames"][-1])[key] = value
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=rf"transforms\.json: {key}: expected .*, got {value}"):
        nerfstudio.read(tmp_path)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", None])
def test_pinholes_are_read(tmp_path, model) -> None:
    """instant-ngp says that they are no fisheyes."""
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    more = {"camera_model": model, "is_fisheye": False, "k4": 0}
    (tmp_path / "transforms.json").write_text(json.dumps(record | more))
    assert nerfstudio.read(tmp_path).shots


@pytest.mark.parametrize("write", [write_romp, write_easymocap_folder])
def test_files_are_numbered_where_each_has_a_number(tmp_path, write) -> None:
    folder = write(tmp_path)
    assert read_poses(folder).numbered
    for name, file in zip("abcd", sorted(folder.iterdir())):
        file.rename(folder / f"{name}{file.suffix}")
    found = read_poses(folder)
    assert not found.numbered and found.poses.frames.tolist() == list(range(FRAMES))


def test_rough_masks_are_made_where_there_are_none(tmp_path) -> None:
    camera = layouts.video_camera(FOCALS["romp"]).resized(4 * WIDTH, 4 * HEIGHT)
    scene = import_source(_film(tmp_path, camera), tmp_path / "out", _options(tmp_path))
    assert any("masks made from the template" in note and "rough" in note for note in scene.notes)
    capture = load_capture(tmp_path / "out")
    for frame in capture.frames:
        truth = view_of(camera, frame.frame).mask
        assert overlap(capture.load_frame(frame).mask > 0.5, truth) > ROUGH


def test_the_sharpest_frame_of_a_pose_is_kept(tmp_path) -> None:
    """Ten frames of two poses in turn, one sharp picture of each: those two are chosen."""
    camera, world = layouts.video_camera(FOCALS["romp"]), layouts.camera_world()
    poses = [0, 3, 0, 3, 0, 3, 0, 3, 0, 3]
    sharp = {4, 5}
    folder, cloth = tmp_path / "frames", np.random.default_rng(0).integers(0, 80, (HEIGHT, WIDTH, 1))
    for k, pose in enumerate(poses):
        view = view_of(camera, pose)
        image = np.where(view.mask[..., None], 100 + cloth, 90).repeat(3, 2).astype(np.uint8)
        write_image(folder / f"{k:03d}.png", image if k in sharp else cv2.GaussianBlur(image, (0, 0), 2.0))
        write_image(tmp_path / "masks" / f"{k:03d}.png", (255 * view.mask).astype(np.uint8))
    np.savez(tmp_path / "p.npz", thetas=world.thetas[poses], transl=world.trans[poses], betas=BETAS)
    K = (camera.K[0, 0], camera.K[1, 1], WIDTH / 2, HEIGHT / 2)
    options = dataclasses.replace(
        _options(tmp_path), poses=tmp_path / "p.npz", masks=tmp_path / "masks", intrinsics=K, count=2
    )
    import_source(folder, tmp_path / "out", options)
    capture = load_capture(tmp_path / "out")
    assert {f.frame for f in capture.frames if f.split == "train"} == sharp


def test_what_a_video_needs_is_asked_for(tmp_path) -> None:
    film = _film(tmp_path, layouts.video_camera(60.0))
    body = str(layouts.body_file(tmp_path))

    def refusal(source: Path = film, **options: object) -> str:
        with pytest.raises(InputError) as caught:
            import_source(source, tmp_path / "out", ImportOptions(**options))
        return str(caught.value)

    assert "--body" in refusal()
    assert "--poses" in refusal(body=body)
    world = layouts.camera_world()
    np.savez(tmp_path / "p.npz", thetas=world.thetas, transl=world.trans)
    assert "--intrinsics" in refusal(body=body, poses=tmp_path / "p.npz")
    for name in ("motion.npz", "body.npz"):  # somebody's own, which a capture's would replace
        (tmp_path / "out").mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_bytes(b"mine")
        assert f"holds a {name}" in refusal(body=body, poses=tmp_path / "p.npz")
        (tmp_path / "out" / name).unlink()
    (tmp_path / "out").rmdir()
    assert "source not found" in refusal(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "known layout" in refusal(tmp_path / "empty")
    assert "--as: expected zju" in refusal(layout="zoo")
    (tmp_path / "cut.mp4").write_bytes(film.read_bytes()[:300])
    assert "cut.mp4" in refusal(tmp_path / "cut.mp4", body=body, poses=tmp_path / "p.npz")
    assert not (tmp_path / "out").exists()
