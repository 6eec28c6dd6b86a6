"""The known scene before its first camera, as pose estimation programs write it, and its frames as images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.smpl import SMPLX_REST_ROOT
from support import layouts
from support.known_scene import BETAS, FRAMES, GREY, HEIGHT, WIDTH, view_of

LENS = layouts.video_camera(77.0)
INTRINSICS = (77.0, 77.0, WIDTH / 2, HEIGHT / 2)
FOCALS = {
    "wham": np.hypot(WIDTH, HEIGHT),
    "phalp": 5000 * HEIGHT / 256,
    "romp": 0.5 * HEIGHT / np.tan(np.radians(30)),
    "gvhmr": 77.0,
}


def frame_image(camera: Camera, k: int) -> np.ndarray:
    """The scene's frame ``k`` on grey, coloured by its normals."""
    view = view_of(camera, k)
    return np.where(view.mask[..., None], to_bytes(0.2 + 0.35 * (view.normals + 1)), GREY).astype(np.uint8)


def write_frames(folder: Path, camera: Camera = LENS, names: Mapping[str, int] | None = None) -> Path:
    """frames/ and masks/ of the scene by name; ``names`` gives each its pose."""
    for name, k in ({f"{k:05d}": k for k in range(FRAMES)} if names is None else names).items():
        write_image(folder / "frames" / f"{name}.png", frame_image(camera, k))
        write_image(folder / "masks" / f"{name}.png", (255 * view_of(camera, k).mask).astype(np.uint8))
    return folder / "frames"


def write_film(folder: Path, camera: Camera = LENS) -> Path:
    """me.mp4 of the scene."""
    layouts.write_video(folder / "me.mp4", [frame_image(camera, k) for k in range(FRAMES)], fps=25)
    return folder / "me.mp4"


def write_poses(folder: Path, rows: Sequence[int] | np.ndarray = range(FRAMES), **members: object) -> Path:
    """poses.npz: SMPL poses in the camera's frame."""
    world, rows = layouts.camera_world(), np.array(rows)
    arrays = {"thetas": world.thetas[rows], "trans": world.trans[rows], "betas": BETAS} | members
    np.savez(folder / "poses.npz", **arrays)
    return folder / "poses.npz"


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
        "transl": world.positions - rest,
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
    """Rotation matrices and a second person in every other image, before ours; ``push`` m farther away."""
    world = layouts.camera_world()
    world.positions = world.positions + np.array([0, 0, push])
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
    """A video's results in one file, by image name; one frame saw nobody."""
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
