"""Motions as pickles or folders: AIST++, WHAM, GVHMR, PHALP, MDM, EasyMocap, a dict of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import is_folder
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp_matrices
from rnd_runtime.motion.smpl import SMPL_REST_ROOT, SMPLX_REST_ROOT

from .unpickle import read_pickle
from .video_fits import PHALP_FOCAL, VideoFits, in_order, is_phalp, read_easymocap_folder, read_phalp

Floats = NDArray[np.float64]

_AIST_FPS, _VIDEO_FPS, _MDM_FPS = 60.0, 30.0, 20.0
_PHONE_FOCAL = 1.2  # of the image's longer side: 45°. PHALP's 3° puts people 100 m away
_MAX_FILLED = 18_000  # frames, 10 minutes
_SCALINGS = (1e-6, 1e6)  # AIST++'s are near 94
_MIN_ROW = 1e-6  # length of a rotation's row, the second orthogonalised
_LEVEL = np.array([1.0, -1.0, -1.0])  # from a camera's right, down, forward to right, up, backward
_VIDEO_NOTE = f"no frame rate in the file: {_VIDEO_FPS:g} frames per second assumed, as most videos have"


@dataclass(frozen=True, eq=False)
class Track:
    """One person's motion as ``members`` of an .npz (``arrays.read_motion_file``).

    ``rest_root`` [3] m: the pelvis' rest position that translations refer to; None for the avatar's own.
    ``notes``: assumptions and omissions.
    """

    members: Members
    rest_root: Floats | None
    notes: tuple[str, ...] = ()


def read_track(path: str | Path) -> Track:
    """Read the motion in a .pkl, .joblib, .pt or .npy, or in a folder of EasyMocap's JSON files.

    All pickles are Y up. Poses in a camera's axes are rotated upright about it.

    ===========  ============================================================================================
    AIST++       ``smpl_poses`` (F,72), ``smpl_trans`` (F,3), ``smpl_scaling``: metres are trans / scaling;
                 60 frames per second
    GVHMR        ``smpl_params_global`` {``body_pose`` (F,63), ``global_orient``, ``transl``}, SMPL-X
    WHAM         {person: {``pose_world`` (F,72), ``trans_world`` (F,3), ``frame_ids``}}: the person seen
                 longest; gaps of a track are interpolated
    PHALP        image → {``tid``, ``smpl`` of rotation matrices, ``camera``}, also 4D-Humans'; depths as
                 before a usual lens
    EasyMocap    a folder of 000000.json, …: {``id``, ``Rh``, ``Th``, ``poses``, ``shapes``}, Z up
    MDM          ``thetas`` (24,6,F) the first two rows of each rotation, or ``thetas_ori`` (24,3,F)
                 axis-angle, and ``root_translation`` (3,F), the pelvis' position; 20 frames per second
    others       a dict with the members of an .npz, or an object array of it
    ===========  ============================================================================================

    Raises:
        InputError: when it is none of them.
    """
    try:
        if is_folder(path):
            return _easymocap(read_easymocap_folder(Path(path)), path)
        content = read_pickle(path, what="motion")
        if not isinstance(content, Mapping) or not content:
            kind = "no keys" if isinstance(content, Mapping) else f"a {type(content).__name__}"
            raise InputError("motion", expected="a dict of arrays", got=kind, file=path)
        return _track(content, path)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        got = f"arrays that do not fit together ({error})"
        raise InputError("motion", expected="poses over time", got=got, file=path) from error


def _track(content: Mapping[Any, Any], path: str | Path) -> Track:
    if "smpl_poses" in content:
        arrays: dict[str, Any] = {
            "poses": content["smpl_poses"],
            "trans": np.asarray(content["smpl_trans"]) / _scaling(content, path),
            "fps": _AIST_FPS,
        }
        return Track(Members(arrays, path), SMPL_REST_ROOT)
    if "smpl_params_global" in content:
        return _video_track(content["smpl_params_global"], path, SMPLX_REST_ROOT, ())
    if "root_translation" in content and ("thetas" in content or "thetas_ori" in content):
        return _mdm(content, path)
    if is_phalp(content):
        return _phalp(read_phalp(content, Path(path)), path)
    people = {who: track for who, track in content.items() if isinstance(track, Mapping) and "pose" in track}
    if people:
        return _wham(people, path)
    return Track(Members({str(name): value for name, value in content.items()}, path), None)


def _scaling(content: Mapping[Any, Any], path: str | Path) -> Any:
    scaling = np.asarray(content.get("smpl_scaling", 1.0)).reshape(-1)[0]
    low, high = _SCALINGS
    if not low <= scaling <= high:
        raise InputError("smpl_scaling", expected=f"{low:g} to {high:g}", got=scaling, file=path)
    return scaling


def _video_track(arrays: Mapping[str, Any], path: str | Path, rest_root: Floats, notes: Sequence[str]) -> Track:
    return Track(Members({"fps": _VIDEO_FPS, **arrays}, path), rest_root, (_VIDEO_NOTE, *notes))


def _mdm(content: Mapping[Any, Any], path: str | Path) -> Track:
    if "thetas_ori" in content:
        poses = np.asarray(content["thetas_ori"], np.float64).transpose(2, 0, 1)
    else:
        rows = np.asarray(content["thetas"], np.float64).transpose(2, 0, 1)
        x = _unit_rows(rows[..., :3], path)
        y = _unit_rows(rows[..., 3:] - (x * rows[..., 3:]).sum(-1, keepdims=True) * x, path)
        poses = matrix_to_axis_angle(np.stack([x, y, np.cross(x, y)], -2))
    trans = np.asarray(content["root_translation"], np.float64).T
    return Track(Members({"poses": poses, "trans": trans, "fps": _MDM_FPS}, path), np.zeros(3))


def _unit_rows(rows: Floats, path: str | Path) -> Floats:
    """``rows`` [F, J, 3] of length 1."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    good = (np.isfinite(lengths) & (lengths > _MIN_ROW)).all((1, 2))
    if not good.all():
        expected, frame = "two rows of a rotation", int(np.argmin(good))
        got = "zeros, parallel rows or no numbers"
        raise InputError("thetas", expected=expected, got=got, file=path, frame=frame)
    unit: Floats = rows / lengths
    return unit


def _wham(people: Mapping[Any, Mapping[str, Any]], path: str | Path) -> Track:
    longest = max(people, key=lambda who: len(people[who]["pose"]))
    notes = _left_out(longest, tuple(who for who in people if who != longest))
    person = people[longest]
    world = "pose_world" in person and "trans_world" in person
    poses, trans = (person[f"{name}_world" if world else name] for name in ("pose", "trans"))
    frames, (poses, trans) = in_order(person.get("frame_ids", np.arange(len(poses))), poses, trans)
    poses, trans, filled = _without_gaps(frames, poses.reshape(len(poses), -1), trans, path)
    if not world:
        poses, trans, level = _upright(poses, trans)
        filled += level
    return _video_track({"poses": poses, "trans": trans}, path, SMPL_REST_ROOT, (*notes, *filled))


def _phalp(fits: VideoFits, path: str | Path) -> Track:
    poses, trans, filled = _without_gaps(fits.frames, fits.axis_angles, fits.translations, path)
    trans = (SMPL_REST_ROOT + trans) * [1, 1, _PHONE_FOCAL / PHALP_FOCAL] - SMPL_REST_ROOT
    poses, trans, level = _upright(poses, trans)
    notes = (*_left_out(fits.person, fits.others), *filled, *level)
    return _video_track({"poses": poses, "trans": trans}, path, SMPL_REST_ROOT, notes)


def _easymocap(fits: VideoFits, path: str | Path) -> Track:
    """EasyMocap's fits as SMPL's: rotation about the pelvis, whose path gaps interpolate."""
    assert fits.turns is not None
    rest_root = SMPLX_REST_ROOT if fits.family == "SMPL-X" else SMPL_REST_ROOT
    rotations, poses = axis_angle_to_matrix(fits.turns), fits.axis_angles.copy()
    poses[:, :3] = matrix_to_axis_angle(rotations @ axis_angle_to_matrix(poses[:, :3]))
    poses, pelvis, filled = _without_gaps(fits.frames, poses, rotations @ rest_root + fits.translations, path)
    arrays = {"poses": poses, "trans": pelvis - rest_root, "up_axis": "z"}
    return _video_track(arrays, path, rest_root, (*_left_out(fits.person, fits.others), *filled))


def _left_out(person: Any, others: tuple[Any, ...]) -> tuple[str, ...]:
    if not others:
        return ()
    return (f"person {person} is taken, who is seen longest; left out: {', '.join(map(str, others))}",)


def _without_gaps(
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


def _upright(poses: Floats, trans: Floats) -> tuple[Floats, Floats, tuple[str, ...]]:
    """SMPL's ``poses`` [F, 3J] and ``trans`` [F, 3] in a camera's axes, rotated Y up, beginning above the origin."""
    poses = poses.copy()
    poses[:, :3] = matrix_to_axis_angle(np.diag(_LEVEL) @ axis_angle_to_matrix(poses[:, :3]))
    pelvis = (SMPL_REST_ROOT + trans) * _LEVEL
    pelvis -= pelvis[0] * [1, 0, 1]
    note = "no world coordinates in the file: the camera is taken to stand level; --in-place keeps the root"
    return poses, pelvis - SMPL_REST_ROOT, (note,)
