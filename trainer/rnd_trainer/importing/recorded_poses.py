"""Body poses of SAM 3D Body, GEM-X, TRAM, PromptHMR and SLAHMR before their camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.formats.rigs import MHR127, Rig
from rnd_runtime.motion.formats.sam3d import read_sam3d
from rnd_runtime.motion.formats.soma import gemx
from rnd_runtime.motion.readers.arrays import check_rotations
from rnd_runtime.motion.readers.tree import MocapTree
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_runtime.motion.readers.video_fits import in_order, one_of
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_REST_ROOT
from rnd_runtime.motion.solving.bones import hips, leg_length
from rnd_runtime.motion.solving.evidence import Tracks
from rnd_runtime.motion.solving.palms import palm_axes
from rnd_runtime.motion.solving.solve import solve

from .poses import Floats, PoseFile, Poses, smpl_poses

_FLIP = np.diag([1.0, -1.0, -1.0])  # right, up, backward ↔ right, down, forward
_FITTED = "the poses are on {}'s skeleton: fitted to the body, at the distance at which its legs look as long"


def sam3d_poses(content: Any, path: Path) -> PoseFile:
    """SAM 3D Body's poses of the person nearest to the camera, on MHR's skeleton."""
    track = read_sam3d(content, path)
    poses = _fitted(track.as_seen(), MHR127, track.frames)
    focal = track.focal
    return PoseFile(
        "SAM 3D Body",
        poses,
        focal=None if focal is None else lambda width, height: focal,
        notes=(*track.notes, _FITTED.format("MHR")),
        numbered=path.is_dir(),
        in_camera=True,
    )


def gemx_poses(content: Mapping[str, Any], path: Path) -> PoseFile:
    """GEM-X' ``body_params_incam``, on SOMA's skeleton."""
    if "body_params_incam" not in content:
        got = ", ".join(map(str, content))
        raise InputError("body poses", expected="body_params_incam", got=got, file=path)
    tree, rig = gemx({"body_params_global": content["body_params_incam"]}, path)
    rotations = tree.rotations.copy()
    rotations[:, 0] = _FLIP @ rotations[:, 0]
    upright = MocapTree(tree.names, tree.parents, tree.offsets, rotations, tree.root_positions @ _FLIP, tree.fps)
    K = np.asarray(content["K_fullimg"], np.float64).reshape(-1, 3, 3)[0] if "K_fullimg" in content else None
    poses = _fitted(upright, rig, np.arange(len(rotations)))
    return PoseFile("GEM-X", poses, K=K, notes=(_FITTED.format("SOMA"),), in_camera=True)


def _fitted(tree: MocapTree, rig: Rig, frames: np.ndarray) -> Poses:
    """Poses of ``tree``, Y up before a level camera at the origin, for any body that is looked at by that camera."""
    recorded = tree.global_rotations()
    positions = tree.positions(recorded)
    matched = rig.matched(tree.names)
    palms = palm_axes(tree, positions, matched)

    def fit(skeleton: Skeleton) -> tuple[Floats, Floats]:
        known = {name: joint for name, joint in matched.items() if name in skeleton.names}
        if missing := [name for name in ("left_hip", "right_hip", "left_knee", "right_knee") if name not in known]:
            raise InputError("joints of the body", expected="hips and knees", got=f"no {', '.join(missing)}")
        points = {name: positions[:, joint] for name, joint in known.items()}
        rotations = {name: recorded[:, joint] for name, joint in known.items()}
        world = solve(Tracks(points, rotations, palms, tree.fps), skeleton)
        rest = dict(zip(skeleton.names, skeleton.rest_joints))
        scale = leg_length({name: rest[name] for name in points}) / leg_length(points)
        root = scale * hips(points) - world[:, 0] @ (hips(rest) - skeleton.rest_joints[0])
        local = world.copy()
        local[:, 1:] = np.swapaxes(world[:, skeleton.parents[1:]], -1, -2) @ world[:, 1:]
        local[:, 0] = _FLIP @ world[:, 0]
        return local, root @ _FLIP

    # until the body is known: upright in the root's place
    still = np.tile(np.eye(3), (len(frames), len(SMPL_NAMES), 1, 1))
    still[:, 0] = _FLIP
    path = positions[:, matched["pelvis"]] @ _FLIP
    return Poses(np.asarray(frames, np.int64), still, lambda rest: path, fit=fit)


def tram_poses(content: Mapping[str, Any], path: Path) -> PoseFile:
    """TRAM's ``pred_rotmat`` and ``pred_trans``; the focal length is in ``camera.npy``, one folder up."""
    matrices = check_rotations(np.asarray(content["pred_rotmat"], np.float64), "pred_rotmat", path)
    angles = matrix_to_axis_angle(matrices).reshape(len(matrices), -1)
    trans = np.asarray(content["pred_trans"], np.float64).reshape(-1, 3)
    betas = content.get("pred_shape", np.zeros((len(angles), 10)))
    frames, members = in_order(content.get("frame", np.arange(len(angles))), angles, trans, betas)
    camera = next((file for up in (path.parent, path.parent.parent) if (file := up / "camera.npy").is_file()), None)
    focal = None
    if camera is not None and isinstance(stated := read_pickle(camera, what="TRAM's camera"), dict):
        focal = stated.get("img_focal")
    length = None if focal is None else float(np.reshape(focal, -1)[0])
    return PoseFile(
        "TRAM",
        smpl_poses(frames, *members),
        focal=None if length is None else lambda width, height: length,
        in_camera=True,
    )


def prompthmr_poses(content: Mapping[str, Any], person: int | None, path: Path) -> PoseFile:
    """PromptHMR's ``people`` → ``smplx_cam`` {``pose`` [F, 165], ``trans``, ``shape``}, ``frames``."""
    people = {int(who): entry for who, entry in content["people"].items() if "smplx_cam" in entry}
    if not people:
        got = "smplx_world alone, of a moving camera"
        raise InputError("body poses", expected="smplx_cam of a person", got=got, hint="--motion plays them", file=path)
    seen = [who for who, entry in people.items() for _ in entry["smplx_cam"]["pose"]]
    chosen, others = one_of(seen, person, path)
    entry = people[chosen]
    body = entry["smplx_cam"]
    poses = np.asarray(body["pose"], np.float64).reshape(len(body["pose"]), -1)
    betas = body.get("shape", np.zeros((len(poses), 10)))
    frames, members = in_order(entry.get("frames", np.arange(len(poses))), poses, body["trans"], betas)
    focal = content.get("camera", {}).get("img_focal")
    length = None if focal is None else float(np.reshape(focal, -1)[0])
    return PoseFile(
        "PromptHMR",
        smpl_poses(frames, *members, family="SMPL-X"),
        focal=None if length is None else lambda width, height: length,
        notes=several(chosen, others),
        in_camera=True,
    )


def slahmr_poses(members: Members, path: Path, person: int | None) -> PoseFile:
    """SLAHMR's people in the axes of its camera of each frame, ``cam_R`` [P, F, 3, 3] and ``cam_t`` [P, F, 3]."""
    trans, root, body = (members.numbers(name) for name in ("trans", "root_orient", "pose_body"))
    seen = members.numbers("track_mask") > 0 if "track_mask" in members.names else np.ones(trans.shape[:2], bool)
    chosen, others = one_of(np.nonzero(seen)[0].tolist(), person, path)
    frames = np.flatnonzero(seen[chosen])
    if not {"cam_R", "cam_t"} <= set(members.names):
        raise InputError("body poses", expected="cam_R and cam_t", got=", ".join(members.names), file=path)
    turn, shift = (members.numbers(name)[chosen][frames] for name in ("cam_R", "cam_t"))
    rotations = turn @ axis_angle_to_matrix(root[chosen][frames])
    pelvis = np.einsum("fij,fj->fi", turn, SMPL_REST_ROOT + trans[chosen][frames]) + shift
    angles = np.concatenate([matrix_to_axis_angle(rotations), body[chosen][frames]], 1)
    betas = members.numbers("betas")[chosen] if "betas" in members.names else None
    K = None
    if "intrins" in members.names:
        fx, fy, cx, cy = members.numbers("intrins").reshape(-1)[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    poses = smpl_poses(frames, angles, pelvis - SMPL_REST_ROOT, betas, family="SMPL-H")
    return PoseFile("SLAHMR", poses, K=K, notes=several(chosen, others), in_camera=True)


def several(chosen: int, others: tuple[int, ...]) -> tuple[str, ...]:
    """A note on the people of a file that are not taken."""
    if not others:
        return ()
    return (f"{len(others) + 1} people in the file: number {chosen} taken, --person chooses another",)
