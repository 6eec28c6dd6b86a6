"""One person of several in a video, in the SMPL family: WHAM, VIBE, TRAM, PromptHMR, SLAHMR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp_matrices
from rnd_runtime.motion.smpl import SMPL_REST_ROOT, SMPLX_REST_ROOT

from .arrays import check_rotations
from .video_fits import in_order, order_notes

Floats = NDArray[np.float64]

VIDEO_FPS = 30.0
_MAX_FILLED = 18_000  # frames, 10 minutes
_LEVEL = np.array([1.0, -1.0, -1.0])  # from a camera's right, down, forward to right, up, backward
_VIDEO_NOTE = f"no frame rate in the file: {VIDEO_FPS:g} frames per second assumed, as most videos have"
_SLAHMR = ("trans", "root_orient", "pose_body")


@dataclass(frozen=True, eq=False)
class Track:
    """One person's motion as ``members`` of an .npz (``arrays.read_arrays``).

    Attributes:
        rest_root: [3] m, the pelvis' rest position that translations refer to; None for the avatar's own.
        notes: assumptions and omissions.
        up: the axis that the layout has up, where the file does not state it; None by its members.
    """

    members: Members
    rest_root: Floats | None
    notes: tuple[str, ...] = ()
    up: str | None = None


def video_track(
    arrays: Mapping[str, Any], path: str | Path, rest_root: Floats | None, notes: Sequence[str], up: str = "y"
) -> Track:
    """A track of a video whose file states no frame rate."""
    return Track(Members({"fps": VIDEO_FPS, **arrays}, path), rest_root, (_VIDEO_NOTE, *notes), up)


def is_prompthmr(content: Mapping[Any, Any]) -> bool:
    """Whether ``content`` is PromptHMR's: ``people`` → ``smplx_world``."""
    people = content.get("people")
    return isinstance(people, Mapping) and any("smplx_world" in person for person in people.values())


def is_slahmr(members: Members) -> bool:
    """Whether ``members`` are SLAHMR's: an axis of people before that of frames."""
    if not set(_SLAHMR) <= set(members.names):
        return False
    return all(members.numbers(name).ndim == 3 for name in _SLAHMR)


def wham(people: Mapping[Any, Mapping[str, Any]], path: str | Path) -> Track:
    """WHAM's {person: ``pose_world``, ``trans_world``}, else ``pose`` and ``trans`` in the camera's axes.

    Without ``trans`` (VIBE, TCMR, MAED) the root stays in place.
    """
    longest, notes = _longest(people, lambda person: len(person["pose"]))
    person = people[longest]
    world = "pose_world" in person and "trans_world" in person
    names = ("pose_world", "trans_world") if world else ("pose", "trans")
    placed = names[1] in person
    poses = np.asarray(person[names[0]], np.float64)
    trans = person[names[1]] if placed else np.zeros((len(poses), 3))
    numbers = person.get("frame_ids", np.arange(len(poses)))
    frames, (poses, trans) = in_order(numbers, poses, trans)
    poses, trans, filled = without_gaps(frames, poses.reshape(len(poses), -1), trans, path)
    notes += order_notes(numbers) + filled
    if world:
        return video_track({"poses": poses, "trans": trans}, path, SMPL_REST_ROOT, notes)
    poses, trans, level = upright(poses, trans)
    if placed:
        return video_track({"poses": poses, "trans": trans, "up_axis": "y"}, path, SMPL_REST_ROOT, (*notes, *level))
    return video_track({"poses": poses, "up_axis": "y"}, path, None, notes)


def tram(content: Mapping[str, Any], path: str | Path) -> Track:
    """TRAM's ``pred_rotmat`` [F, 24, 3, 3] and ``pred_trans`` [F, 1, 3] of one person, in the camera's axes."""
    matrices = np.asarray(content["pred_rotmat"], np.float64)
    trans = np.asarray(content["pred_trans"], np.float64).reshape(-1, 3)
    poses = matrix_to_axis_angle(check_rotations(matrices, "pred_rotmat", path)).reshape(len(matrices), -1)
    numbers = content.get("frame", np.arange(len(poses)))
    frames, (poses, trans) = in_order(numbers, poses, trans)
    poses, trans, filled = without_gaps(frames, poses, trans, path)
    poses, trans, level = upright(poses, trans)
    arrays = {"poses": poses, "trans": trans, "up_axis": "y"}
    return video_track(arrays, path, SMPL_REST_ROOT, (*order_notes(numbers), *filled, *level))


def prompthmr(content: Mapping[Any, Any], path: str | Path) -> Track:
    """PromptHMR's ``people`` → ``smplx_world`` {``pose`` [F, 165], ``trans``}, ``frames``."""
    people = {who: person for who, person in content["people"].items() if "smplx_world" in person}
    longest, notes = _longest(people, lambda person: len(person["smplx_world"]["pose"]))
    person = people[longest]
    world = person["smplx_world"]
    poses = np.asarray(world["pose"], np.float64)
    numbers = person.get("frames", np.arange(len(poses)))
    frames, (poses, trans) = in_order(numbers, poses, world["trans"])
    poses, trans, filled = without_gaps(frames, poses.reshape(len(poses), -1), trans, path)
    notes += order_notes(numbers) + filled
    return video_track({"poses": poses, "trans": trans}, path, SMPLX_REST_ROOT, notes)


def slahmr(members: Members, path: str | Path) -> Track:
    """SLAHMR's ``trans`` [P, F, 3], ``root_orient`` [P, F, 3], ``pose_body`` [P, F, 63] of P people.

    Its world is the first camera's, rotated so that the normal of ``floor_plane`` is up.
    """
    trans, root, body = (members.numbers(name) for name in _SLAHMR)
    seen = members.numbers("track_mask") if "track_mask" in members.names else np.ones(trans.shape[:2])
    if not len(trans) == len(root) == len(body) == len(seen) > 0:
        got = ", ".join(str(len(array)) for array in (trans, root, body, seen))
        raise InputError("people in the file", expected="as many of each array", got=got, file=path)
    longest, notes = _longest(dict(enumerate(seen > 0)), lambda mask: int(mask.sum()))
    frames = np.flatnonzero(seen[longest] > 0)
    if not len(frames):
        raise InputError("track_mask", expected="a person in at least one frame", got="none", file=path)
    parts = [root[longest], body[longest]]
    if "hand_pose" in members.names and members.numbers("hand_pose").shape == (*trans.shape[:2], 90):
        parts.append(members.numbers("hand_pose")[longest])
    poses = np.concatenate(parts, 1)[frames]
    poses, positions, filled = without_gaps(frames, poses, trans[longest][frames], path)
    positions = positions + SMPL_REST_ROOT
    plane = members.numbers("floor_plane").reshape(-1) if "floor_plane" in members.names else np.zeros(3)
    normal = plane[:3]  # of the first person, who shares it with the others
    arrays: dict[str, Any] = {}
    if np.linalg.norm(normal) > 0:
        poses, positions = _on_floor(poses, positions, normal / np.linalg.norm(normal))
        arrays["up_axis"] = "y"
    arrays |= {"poses": poses, "trans": positions - SMPL_REST_ROOT}
    return video_track(arrays, path, SMPL_REST_ROOT, (*notes, *filled))


def _on_floor(poses: Floats, positions: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """Poses and pelvis positions in a world with the floor's ``normal``, on the person's side, up."""
    rotations = axis_angle_to_matrix(poses[:, :3])
    if rotations[:, :, 1].mean(0) @ normal < 0:
        normal = -normal
    axis = np.cross(normal, [0.0, 1.0, 0.0])
    sine, cosine = np.linalg.norm(axis), normal[1]
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    turn = axis_angle_to_matrix(axis * np.arctan2(sine, cosine))
    poses = poses.copy()
    poses[:, :3] = matrix_to_axis_angle(turn @ rotations)
    return poses, positions @ turn.T


def _longest(people: Mapping[Any, Any], length: Any) -> tuple[Any, tuple[str, ...]]:
    """The person seen longest, and a note on the others."""
    longest = max(people, key=lambda who: length(people[who]))
    return longest, left_out(longest, tuple(who for who in people if who != longest))


def left_out(person: Any, others: tuple[Any, ...]) -> tuple[str, ...]:
    """A note on the people of the file that are not taken."""
    if not others:
        return ()
    return (f"person {person} is taken, who is seen longest; left out: {', '.join(map(str, others))}",)


def without_gaps(
    frames: NDArray[np.int64], poses: Floats, positions: Floats, path: str | Path
) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Axis-angle ``poses`` [F, 3J] and ``positions`` [F, 3] of ascending ``frames``, with gaps interpolated."""
    late = np.flatnonzero(np.diff(frames) <= 0)
    if len(late):
        got = "{1} after {0}".format(*frames[late[0] : late[0] + 2])
        raise InputError("frame numbers", expected="some that ascend", got=got, file=path)
    missing = int(frames[-1]) - int(frames[0]) + 1 - len(frames)
    if missing == 0:
        return poses, positions, ()
    if missing > (most := max(len(frames), _MAX_FILLED)):
        got = f"{missing} missing between {frames[0]} and {frames[-1]}"
        raise InputError("frame numbers", expected=f"at most {most} left out", got=got, file=path)
    wanted = np.arange(frames[0], frames[-1] + 1)
    after = np.clip(np.searchsorted(frames, wanted), 1, len(frames) - 1)
    t = (wanted - frames[after - 1]) / (frames[after] - frames[after - 1])
    matrices = axis_angle_to_matrix(poses.reshape(len(poses), -1, 3))
    filled = matrix_to_axis_angle(slerp_matrices(matrices[after - 1], matrices[after], t[:, None]))
    between = (1 - t[:, None]) * positions[after - 1] + t[:, None] * positions[after]
    note = f"{missing} frames without the person are filled in between their neighbours"
    return filled.reshape(len(wanted), -1), between, (note,)


def upright(poses: Floats, trans: Floats) -> tuple[Floats, Floats, tuple[str, ...]]:
    """SMPL's ``poses`` [F, 3J] and ``trans`` [F, 3] in a camera's axes, rotated Y up, beginning above the origin."""
    poses = poses.copy()
    poses[:, :3] = matrix_to_axis_angle(np.diag(_LEVEL) @ axis_angle_to_matrix(poses[:, :3]))
    pelvis = (SMPL_REST_ROOT + trans) * _LEVEL
    pelvis -= pelvis[0] * [1, 0, 1]
    note = "no world coordinates in the file: the camera is taken to stand level; --in-place keeps the root"
    return poses, pelvis - SMPL_REST_ROOT, (note,)
