"""Poses of programs with cameras or skeletons of their own, for rnd-data import."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.formats.rigs import MHR127, SOMA77
from rnd_runtime.motion.smpl import SMPL_REST_ROOT, SMPLX_REST_ROOT
from rnd_trainer.importing.pose_files import read_poses
from rnd_trainer.importing.poses import on_body, transformed
from support import layouts
from support.foreign_motion import (
    FLIP,
    FRAMES,
    LEVEL,
    MHR_JOINTS,
    PELVIS,
    SKELETON,
    SOMA_JOINTS,
    WORLD,
    write_gemx,
    write_kimodo,
    write_sam3d,
)
from support.known_motion import write_npz, write_pickle, write_vibe
from support.known_scene import BETAS
from support.known_scene import FRAMES as SHOTS

LIMBS = ("elbow", "wrist", "knee", "ankle")
ROLLS = 6.0  # degrees
SEEN = 0.03  # of a person's height in the image: 24 joints of another skeleton


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    between = Rotation.from_matrix((a.swapaxes(-1, -2) @ b).reshape(-1, 3, 3))
    return float(np.degrees(between.magnitude()).max())


SKELETONS = {
    **{
        f"SAM 3D Body, {form}": (lambda f, form=form: write_sam3d(f, form), MHR127, MHR_JOINTS)
        for form in ("list", "npz")
    },
    "SAM 3D Body, folder": (lambda f: write_sam3d(f, "folder"), MHR127, MHR_JOINTS),
    "GEM-X": (write_gemx, SOMA77, SOMA_JOINTS),
}


@pytest.mark.parametrize("name", SKELETONS)
def test_a_body_is_fitted_to_other_skeletons_before_the_camera(tmp_path, name):
    write, rig, joints = SKELETONS[name]
    found = read_poses(write(tmp_path))
    numbered = name == "SAM 3D Body, folder"
    assert (found.in_camera, found.numbered) == (True, numbered)
    assert found.poses.frames.tolist() == list(range(7 * numbered, FRAMES + 7 * numbered))
    assert (float(found.K[0, 0]) if found.focal is None else found.focal(640, 480)) == 900
    poses = on_body(found.poses, SKELETON, "template")
    truth = WORLD[..., :3, :3].copy()
    fitted = SKELETON.joint_transforms(poses.rotations, poses.root(np.zeros(3)) - SKELETON.rest_joints[0])
    for k, joint in enumerate(SKELETON.names):
        if joint.endswith(("shoulder", "elbow", "hip", "knee")):
            assert _angle(fitted[:, k, :3, :3], FLIP @ truth[:, k]) < ROLLS, joint
    recorded = (joints - PELVIS[0] * [1, 0, 1] + LEVEL) @ FLIP
    theirs = {ours: rig.names.index(name) for name, ours in rig.ours.items()}
    limbs = [k for k, joint in enumerate(SKELETON.names) if joint.endswith(LIMBS)]
    seen = recorded[:, [theirs[SKELETON.names[k]] for k in limbs]]
    ours = fitted[..., :3, 3][:, limbs]
    height = np.ptp(recorded[0, :, 1] / recorded[0, :, 2])
    off = np.linalg.norm(ours[..., :2] / ours[..., 2:] - seen[..., :2] / seen[..., 2:], axis=-1)
    assert off.max() < SEEN * height


def test_fitted_poses_follow_their_camera(tmp_path):
    found = read_poses(write_sam3d(tmp_path))
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    motion[:3, 3] = [1, 2, 3]
    here, there = on_body(found.poses, SKELETON, ""), on_body(transformed(found.poses, motion), SKELETON, "")
    assert_allclose(there.rotations[:, 0], motion[:3, :3] @ here.rotations[:, 0], atol=1e-9)
    rest = np.zeros(3)
    assert_allclose(there.root(rest), here.root(rest) @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)


def test_rotations_that_contradict_positions_are_refused(tmp_path):
    file = write_sam3d(tmp_path, "npz")
    members = dict(np.load(file))
    members["pred_global_rots"] = np.random.default_rng(0).permutation(members["pred_global_rots"])
    with pytest.raises(InputError, match="pred_global_rots: expected rotations of pred_joint_coords"):
        read_poses(write_npz(tmp_path / "b.npz", **members))


def _tram(folder, world):
    matrices = axis_angle_to_matrix(world.thetas.reshape(SHOTS, 24, 3))
    (folder / "hps").mkdir()
    content = {"pred_rotmat": matrices, "pred_trans": world.trans[:, None], "frame": np.arange(SHOTS)}
    np.save(folder / "hps/hps_track_0.npy", content | {"pred_shape": np.tile(BETAS, (SHOTS, 1))}, allow_pickle=True)
    np.save(folder / "camera.npy", {"img_focal": 77.0, "img_center": np.zeros(2)}, allow_pickle=True)
    return folder / "hps/hps_track_0.npy"


def _prompthmr(folder, world):
    pose = np.zeros((SHOTS, 165))
    pose[:, :66] = world.thetas[:, :66]
    trans = world.positions - SMPLX_REST_ROOT
    ours = {"pose": pose, "trans": trans, "shape": np.tile(BETAS, (SHOTS, 1))}
    short = {name: value[:1] for name, value in ours.items()}
    elsewhere = ours | {"trans": trans + 9}
    people = {
        4: {"smplx_cam": ours, "smplx_world": elsewhere, "frames": np.arange(SHOTS)},
        5: {"smplx_cam": short, "smplx_world": short, "frames": np.arange(1)},
    }
    return write_pickle(folder / "results.pkl", {"camera": {"img_focal": 77.0}, "people": people})


def _slahmr(folder, world):
    """Its world is any, and its camera moves through it."""
    turns = Rotation.random(SHOTS, random_state=1)
    shift = np.random.default_rng(2).normal(size=(SHOTS, 3))
    root = turns.inv() * Rotation.from_rotvec(world.thetas[:, :3])
    pelvis = turns.inv().apply(world.positions - shift)
    ours = {"root_orient": root.as_rotvec(), "pose_body": world.thetas[:, 3:66], "trans": pelvis - SMPL_REST_ROOT}
    cameras = {"cam_R": turns.as_matrix(), "cam_t": shift}
    members = {name: np.stack([value, np.zeros_like(value)]) for name, value in (ours | cameras).items()}
    mask = np.ones((2, SHOTS))
    mask[1, 1:] = 0
    betas = np.tile(np.append(BETAS, np.zeros(6)), (2, 1))
    return write_npz(
        folder / "me_world_results.npz", **members, track_mask=mask, intrins=[77.0, 77, 24, 32], betas=betas
    )


WORLDS = {"tram": (_tram, 24, SMPL_REST_ROOT), "prompthmr": (_prompthmr, 55, SMPLX_REST_ROOT)}
WORLDS |= {"slahmr": (_slahmr, 22, SMPL_REST_ROOT)}


@pytest.mark.parametrize("program", WORLDS)
def test_poses_of_each_program_agree_in_camera_axes(tmp_path, program):
    write, joints, rest = WORLDS[program]
    world = layouts.camera_world()
    if program == "tram":
        rest = world.rest
    found = read_poses(write(tmp_path, world))
    focal = float(found.K[0, 0]) if found.focal is None else found.focal(48, 64)
    assert focal == 77 and found.in_camera
    assert_allclose(found.poses.root(rest), world.positions, atol=1e-6)
    truth = axis_angle_to_matrix(world.thetas.reshape(SHOTS, 24, 3))
    assert_allclose(found.poses.rotations[:, :22], truth[:, :22], atol=1e-6)
    assert len(found.poses.joint_names) == joints
    assert_allclose(found.poses.betas[:10], BETAS, atol=1e-6)
    if program != "tram":
        assert "2 people in the file" in found.notes[0]
        assert len(read_poses(write(tmp_path, world), person=5 if program == "prompthmr" else 1).poses.frames) == 1


def test_a_program_without_positions_is_refused_with_the_reason(tmp_path):
    with pytest.raises(InputError, match=r"VIBE's, TCMR's or MAED's, which give no positions \(--motion plays them"):
        read_poses(write_vibe(tmp_path))


def test_a_generated_motion_is_no_poses_of_a_video(tmp_path):
    with pytest.raises(InputError, match=r"Kimodo's, a generated motion \(it goes to --motion\)"):
        read_poses(write_kimodo(tmp_path))


def test_prompthmr_without_its_camera_is_refused(tmp_path):
    people = {1: {"smplx_world": {"pose": np.zeros((2, 165)), "trans": np.zeros((2, 3))}}}
    with pytest.raises(InputError, match="expected smplx_cam of a person, got smplx_world alone"):
        read_poses(write_pickle(tmp_path / "a.pkl", {"people": people}))
