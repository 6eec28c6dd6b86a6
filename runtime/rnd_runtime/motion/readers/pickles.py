"""Motions in pickles: AIST++, WHAM, GVHMR, PHALP, TRAM, PromptHMR, VIBE, MDM; and EasyMocap's folders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.smpl import SMPL_REST_ROOT, SMPLX_REST_ROOT

from .tracks import Track, is_prompthmr, left_out, prompthmr, tram, upright, video_track, wham, without_gaps
from .video_fits import PHALP_FOCAL, VideoFits, is_phalp, read_easymocap_folder, read_phalp

Floats = NDArray[np.float64]

_AIST_FPS, _MDM_FPS = 60.0, 20.0
_PHONE_FOCAL = 1.2  # of the image's longer side: 45°. PHALP's 3° puts people 100 m away
_SCALINGS = (1e-6, 1e6)  # AIST++'s are near 94
_SHOWN = 8  # keys of a dict in messages
_MIN_ROW = 1e-6  # length of a rotation's row, the second orthogonalised


def track_of_folder(path: Path) -> Track:
    """The motion in a folder of EasyMocap's JSON files."""
    return _easymocap(read_easymocap_folder(path), path)


def track_of(content: Mapping[Any, Any], path: str | Path) -> Track:
    """The motion in the ``content`` of a pickle.

    All pickles are Y up. Poses in a camera's axes are rotated upright about it.

    ===========  ============================================================================================
    AIST++       ``smpl_poses`` (F,72), ``smpl_trans`` (F,3), ``smpl_scaling``: metres are trans / scaling;
                 60 frames per second
    GVHMR        ``smpl_params_global`` {``body_pose`` (F,63), ``global_orient``, ``transl``}, SMPL-X
    WHAM         {person: {``pose_world`` (F,72), ``trans_world`` (F,3), ``frame_ids``}}: the person seen
                 longest; gaps of a track are interpolated
    VIBE         {person: {``pose`` (F,72), ``frame_ids``}}, also TCMR's and MAED's: no positions, so in place
    TRAM         ``pred_rotmat`` (F,24,3,3), ``pred_trans`` (F,1,3), ``frame``
    PromptHMR    ``people`` → {``smplx_world`` {``pose`` (F,165), ``trans``}, ``frames``}
    PHALP        image → {``tid``, ``smpl`` of rotation matrices, ``camera``}, also 4D-Humans'; depths as
                 before a usual lens
    MDM          ``thetas`` (24,6,F) the first two rows of each rotation, or ``thetas_ori`` (24,3,F)
                 axis-angle, and ``root_translation`` (3,F), the pelvis' position; 20 frames per second
    others       a dict with the members of an .npz, or an object array of it
    ===========  ============================================================================================

    Raises:
        InputError: arrays that do not fit together.
    """
    if "smpl_poses" in content:
        arrays: dict[str, Any] = {
            "poses": content["smpl_poses"],
            "trans": np.asarray(content["smpl_trans"]) / _scaling(content, path),
            "fps": _AIST_FPS,
        }
        return Track(Members(arrays, path), SMPL_REST_ROOT, up="y")
    if "smpl_params_global" in content:
        return video_track(content["smpl_params_global"], path, SMPLX_REST_ROOT, ())
    if "root_translation" in content and ("thetas" in content or "thetas_ori" in content):
        return _mdm(content, path)
    if is_phalp(content):
        return _phalp(read_phalp(content, Path(path)), path)
    if {"pred_rotmat", "pred_trans"} <= content.keys():
        return tram(content, path)
    if is_prompthmr(content):
        return prompthmr(content, path)
    people = {who: track for who, track in content.items() if isinstance(track, Mapping) and "pose" in track}
    if people:
        return wham(people, path)
    if all(isinstance(value, Mapping | list | tuple | str) for value in content.values()):
        raise InputError("motion", expected="a dict of arrays", got=described(content), file=path)
    return Track(Members({str(name): value for name, value in content.items()}, path), None)


def described(content: Any, levels: int = 3) -> str:
    """What ``content`` is, by the keys of the first dicts in it."""
    if isinstance(content, Mapping):
        inner = next((value for value in content.values() if isinstance(value, Mapping)), None)
        names = ", ".join(map(str, list(content)[:_SHOWN])) or "no keys"
        return names if inner is None or not levels else f"{names}: {described(inner, levels - 1)}"
    if isinstance(content, list | tuple) and content and levels:
        return f"a {type(content).__name__} of {described(content[0], levels - 1)}"
    return f"a {type(content).__name__}"


def _scaling(content: Mapping[Any, Any], path: str | Path) -> Any:
    scaling = np.asarray(content.get("smpl_scaling", 1.0)).reshape(-1)[0]
    low, high = _SCALINGS
    if not low <= scaling <= high:
        raise InputError("smpl_scaling", expected=f"{low:g} to {high:g}", got=scaling, file=path)
    return scaling


def _mdm(content: Mapping[Any, Any], path: str | Path) -> Track:
    if "thetas_ori" in content:
        poses = np.asarray(content["thetas_ori"], np.float64).transpose(2, 0, 1)
    else:
        rows = np.asarray(content["thetas"], np.float64).transpose(2, 0, 1)
        x = _unit_rows(rows[..., :3], path)
        y = _unit_rows(rows[..., 3:] - (x * rows[..., 3:]).sum(-1, keepdims=True) * x, path)
        poses = matrix_to_axis_angle(np.stack([x, y, np.cross(x, y)], -2))
    trans = np.asarray(content["root_translation"], np.float64).T
    return Track(Members({"poses": poses, "trans": trans, "fps": _MDM_FPS}, path), np.zeros(3), up="y")


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


def _phalp(fits: VideoFits, path: str | Path) -> Track:
    poses, trans, filled = without_gaps(fits.frames, fits.axis_angles, fits.translations, path)
    trans = (SMPL_REST_ROOT + trans) * [1, 1, _PHONE_FOCAL / PHALP_FOCAL] - SMPL_REST_ROOT
    poses, trans, level = upright(poses, trans)
    notes = (*left_out(fits.person, fits.others), *filled, *level)
    arrays = {"poses": poses, "trans": trans, "up_axis": "y"}
    return video_track(arrays, path, SMPL_REST_ROOT, notes)


def _easymocap(fits: VideoFits, path: str | Path) -> Track:
    """EasyMocap's fits as SMPL's: rotation about the pelvis, whose path gaps interpolate."""
    assert fits.turns is not None
    rest_root = SMPLX_REST_ROOT if fits.family == "SMPL-X" else SMPL_REST_ROOT
    rotations, poses = axis_angle_to_matrix(fits.turns), fits.axis_angles.copy()
    poses[:, :3] = matrix_to_axis_angle(rotations @ axis_angle_to_matrix(poses[:, :3]))
    poses, pelvis, filled = without_gaps(fits.frames, poses, rotations @ rest_root + fits.translations, path)
    arrays = {"poses": poses, "trans": pelvis - rest_root}
    return video_track(arrays, path, rest_root, (*left_out(fits.person, fits.others), *filled), up="z")
