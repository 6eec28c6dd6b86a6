"""One known motion, and writers of it in other programs' formats."""

from __future__ import annotations

import json
import pickle  # noqa: TID251  # to write what others write
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rnd_runtime.capture.body import Body
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_REST_ROOT, SMPLH_NAMES, SMPLX_NAMES, SMPLX_REST_ROOT
from support.paths import ASSETS

SKELETON = Body.load(ASSETS / "body.npz").skeleton
FRAMES = 12
DOUBLE, SINGLE = 1e-9, 2e-6
TEXT = 1e-5  # of BVH and AMC, which are written with eight digits behind the point
METRES = 1e-4  # their root's position in hundredths or inches, and the floor
Y_UP = np.eye(3)
Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])  # a point (x, y, z) of ours is (x, −z, y) there


def _motion() -> tuple[np.ndarray, np.ndarray]:
    """Axis-angles [F, 24, 3] of somebody who waves and steps, hands at rest, and the pelvis' place [F, 3] m."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 1, FRAMES)[:, None, None]
    poses = 0.5 * np.sin(2 * np.pi * t + rng.normal(size=(24, 3))) * rng.uniform(0.2, 1, (24, 3))
    poses[:, 22:] = 0
    poses[:, [SMPL_NAMES.index(end) for end in ("head", "left_foot", "right_foot")]] *= 0.5
    for joint, name in enumerate(SMPL_NAMES):  # knees and elbows bend about one axis
        if name.endswith(("_knee", "_elbow")):
            side = 1 if name.startswith("left") else -1
            axis = np.array([1, 0, 0]) if name.endswith("_knee") else np.array([0, -side, 0])
            poses[:, joint] = (0.7 + 0.5 * np.sin(2 * np.pi * t[:, 0] + joint)) * axis
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


def flat(poses: np.ndarray) -> np.ndarray:
    return poses.reshape(len(poses), -1)


def write_pickle(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def write_npz(path: Path, **members: object) -> Path:
    np.savez(path, **members)
    return path


def _amass(folder, names=SMPLH_NAMES, root=SMPL_REST_ROOT, fps="mocap_framerate"):
    poses = flat(_z_up(_wide(names)))
    return write_npz(
        folder / "a.npz", **{"poses": poses, "trans": PELVIS @ Z_UP.T - root, fps: 30.0, "gender": "neutral"}
    )


def _stageii(folder, fingers=True):
    """Newer AMASS without its joined ``poses``."""
    poses = flat(_z_up(_wide(SMPLX_NAMES)))
    hands = {"pose_hand": poses[:, 75:]} if fingers else {}
    return write_npz(
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
    members = {f"poses{suffix}": flat(poses) if not suffix else poses, f"Rh{suffix}": root.as_rotvec().reshape(shape)}
    return write_npz(folder / "motion.npz", **members, **{f"Th{suffix}": place.reshape(shape)}, fps=30.0)


def write_easymocap(folder, frames=range(7, 7 + FRAMES), columns=72, root=SMPL_REST_ROOT):
    """EasyMocap's own: a file a frame, Z up, somebody else in the first half; ``columns`` by body model."""
    turn = Rotation.from_matrix(Z_UP) * Rotation.from_rotvec(POSES[:, 0])
    place = PELVIS @ Z_UP.T - turn.apply(root)
    poses = np.zeros((FRAMES, columns))
    poses[:, 3:66] = flat(POSES[:, 1:22])
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
    files = write_easymocap(folder)
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


def write_phalp(folder, frames=range(FRAMES)):
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
    return write_pickle(folder / "phalp_me.pkl", content)


def write_wham_in_camera(folder):
    """WHAM without its estimate of the world."""
    matrices, trans = _before_a_camera()
    pose = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(FRAMES, 72)
    return write_pickle(folder / "wham_output.pkl", {0: {"pose": pose, "trans": trans, "frame_ids": np.arange(FRAMES)}})


def _aist(folder):
    scaling = 93.7
    content = {
        "smpl_poses": flat(POSES).astype(np.float32),
        "smpl_trans": (PELVIS - SMPL_REST_ROOT) * scaling,
        "smpl_scaling": np.array([scaling]),
        "smpl_loss": 0.1,
    }
    return write_pickle(folder / "gBR.pkl", content)


def write_wham(folder):
    """Two people; the longer track has a gap of one frame in the middle of a steady turn."""
    track = {
        "pose": np.zeros((FRAMES, 72)),
        "trans": np.zeros((FRAMES, 3)),
        "pose_world": flat(POSES),
        "trans_world": PELVIS - SMPL_REST_ROOT,
        "betas": np.zeros((FRAMES, 10)),
        "frame_ids": np.arange(7, 7 + FRAMES),
    }
    short = {name: value[:4] for name, value in track.items()}
    return write_pickle(folder / "wham_output.pkl", {0: short, 3: track})


def _gvhmr(folder):
    tensors = {
        "body_pose": flat(POSES[:, 1:22]),
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


def write_tram(folder):
    """TRAM's of one person, before the camera, with its fourth image twice."""
    matrices, trans = _before_a_camera()
    order = [*range(FRAMES), 3]
    content = {
        "pred_cam": np.zeros((FRAMES + 1, 3)),
        "pred_rotmat": matrices[order].astype(np.float32),
        "pred_trans": trans[order, None],
        "pred_shape": np.zeros((FRAMES + 1, 10)),
        "frame": np.array(order),
    }
    np.save(folder / "hps_track_0.npy", content, allow_pickle=True)
    return folder / "hps_track_0.npy"


def write_vibe(folder):
    """VIBE's, TCMR's and MAED's: before the camera, without positions."""
    matrices, _ = _before_a_camera()
    pose = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(FRAMES, 72)
    person = {"pose": pose, "betas": np.zeros((FRAMES, 10)), "pred_cam": np.ones((FRAMES, 3)), "joints2d": None}
    return write_pickle(folder / "vibe_output.pkl", {1: person | {"frame_ids": np.arange(FRAMES)}})


def _prompthmr(folder):
    """PromptHMR's, a shorter person before ours."""
    world = {"pose": flat(_wide(SMPLX_NAMES)), "trans": PELVIS - SMPLX_REST_ROOT, "shape": np.zeros((FRAMES, 10))}
    short = {name: value[:3] for name, value in world.items()}
    frames = np.arange(FRAMES)
    people = {1: {"smplx_world": short, "frames": frames[:3]}, 2: {"smplx_world": world, "frames": frames}}
    return write_pickle(folder / "results.pkl", {"camera": {"img_focal": 1000.0}, "people": people})


def write_slahmr(folder, turn=None):
    """SLAHMR's: two people, of whom the second is seen longer; its world is any, ``turn`` [3, 3] of ours."""
    root, pelvis = Rotation.from_rotvec(POSES[:, 0]), PELVIS
    plane = np.zeros(3)
    if turn is not None:
        root, pelvis, plane = Rotation.from_matrix(turn) * root, PELVIS @ turn.T, -2 * turn[:, 1]
    mask = np.ones((2, FRAMES))
    mask[0, 3:] = 0
    members = {"root_orient": root.as_rotvec(), "pose_body": flat(POSES[:, 1:22]), "trans": pelvis - SMPL_REST_ROOT}
    two = {name: np.stack([np.zeros_like(value), value]) for name, value in members.items()}
    return write_npz(
        folder / "me_000100_world_results.npz",
        **two,
        hand_pose=np.zeros((2, FRAMES, 90)),
        floor_plane=[plane, plane],
        track_mask=mask,
        cam_R=np.tile(np.eye(3), (2, FRAMES, 1, 1)),
    )


def _motion_x(folder):
    """Motion-X' 322 columns."""
    numbers = np.zeros((FRAMES, 322))
    numbers[:, :66], numbers[:, 309:312] = flat(POSES[:, :22]), PELVIS - SMPLX_REST_ROOT
    numbers[:, 159:209] = 0.5  # expressions
    np.save(folder / "motionx.npy", numbers)
    return folder / "motionx.npy"


def _beat2(folder):
    """BEAT2's and EMAGE's: AMASS' members, but Y up."""
    return write_npz(
        folder / "beat2.npz",
        poses=flat(_wide(SMPLX_NAMES)),
        trans=PELVIS - SMPLX_REST_ROOT,
        expressions=np.zeros((FRAMES, 100)),
        model="smplx2020",
        mocap_frame_rate=30,
    )


def _matrices(folder):
    return write_npz(folder / "a.npz", poses=MATRICES, trans=PELVIS - SKELETON.rest_joints[0], fps=30)


TILTED = Rotation.from_euler("xyz", [170, 20, 10], degrees=True).as_matrix()

LAYOUTS = {
    "SLAHMR": (write_slahmr, 30, DOUBLE),
    "PromptHMR": (_prompthmr, 30, DOUBLE),
    "Motion-X": (_motion_x, 30, DOUBLE),
    "BEAT2": (_beat2, 30, DOUBLE),
    "rotation matrices": (_matrices, 30, DOUBLE),
    "AMASS, SMPL-H": (_amass, 30, DOUBLE),
    "AMASS, SMPL-X": (lambda f: _amass(f, SMPLX_NAMES, SMPLX_REST_ROOT, "mocap_frame_rate"), 30, DOUBLE),
    "AMASS, split": (_stageii, 30, DOUBLE),
    "AMASS, split, body only": (lambda f: _stageii(f, fingers=False), 30, DOUBLE),
    "EasyVolcap": (_easymocap, 30, DOUBLE),
    "pose_seq": (lambda f: _easymocap(f, "_all", (FRAMES, 1, 3)), 30, DOUBLE),
    "EasyMocap, SMPL": (write_easymocap, 30, DOUBLE),
    "EasyMocap, SMPL-H": (lambda f: write_easymocap(f, columns=78), 30, DOUBLE),
    "EasyMocap, SMPL-X": (lambda f: write_easymocap(f, columns=87, root=SMPLX_REST_ROOT), 30, DOUBLE),
    "EasyMocap without its root": (_rootless, 30, DOUBLE),
    "AIST++": (_aist, 60, SINGLE),
    "WHAM": (write_wham, 30, DOUBLE),
    "GVHMR": (_gvhmr, 30, SINGLE),
    "MDM": (_mdm, 20, SINGLE),
    "GoMAvatar": (_gomavatar, 20, DOUBLE),
    "dict in a pickle": (
        lambda f: write_pickle(f / "a.pkl", {"poses": POSES, "trans": PELVIS - SKELETON.rest_joints[0], "fps": 30}, 2),
        30,
        DOUBLE,
    ),
}
