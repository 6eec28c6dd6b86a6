"""The .npz layouts motions come in, read into one record in the file's own axes (FORMATS.md section 3.9)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .npz import Npz
from .rotations import axis_angle_to_matrix
from .skeleton import SMPL_NAMES

Floats = NDArray[np.float64]

_FINGERS = tuple(f"{name}{k}" for name in ("index", "middle", "pinky", "ring", "thumb") for k in "123")
_HANDS = tuple(f"{side}_{finger}" for side in ("left", "right") for finger in _FINGERS)
SMPLH_NAMES: tuple[str, ...] = SMPL_NAMES[:22] + _HANDS
SMPLX_NAMES: tuple[str, ...] = (*SMPL_NAMES[:22], "jaw", "left_eye", "right_eye", *_HANDS)
_NAMES_BY_COUNT = {22: SMPL_NAMES[:22], 24: SMPL_NAMES, 52: SMPLH_NAMES, 55: SMPLX_NAMES}

# Where SMPL's mean body (betas 0) has its pelvis. Files of that family place the origin, not the pelvis.
SMPL_REST_ROOT: Floats = np.array([-0.0018, -0.2233, 0.0282])
SMPLX_REST_ROOT: Floats = np.array([0.0031, -0.3514, 0.0120])

_MAX_ANGLE = 100.0  # rad: 15 turns. Fits carry a few turns at most, degrees and garbage are beyond
_MAX_DISTANCE = 1000.0  # m: farther means millimetres or garbage
_DEFAULT_FPS = 60.0


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """What a motion file says, in its own axes.

    Attributes:
        rotations: [F, J, 3, 3] local rotations, the root first.
        translations: [F, 3] m, added to the root's rest position.
        rest_root: [3] m, the rest position that ``translations`` was made for; None for the avatar's own.
        joint_names: J names.
        fps: frames per second.
        up: the axis that points up, "y" or "z".
        notes: what had to be assumed or left out.
    """

    rotations: Floats
    translations: Floats
    rest_root: Floats | None
    joint_names: tuple[str, ...]
    fps: float
    up: str
    notes: tuple[str, ...]


def read_motion_file(path: str | Path, joint_names: tuple[str, ...] | None = None) -> MotionRecord:
    """Read a motion from an .npz of a known layout.

    ======================================================  ==========================================  ====
    members                                                 joints                                      up
    ======================================================  ==========================================  ====
    ``poses`` (F,156) or (F,52,3), ``trans``                AMASS, SMPL-H                               z
    ``poses`` (F,165) or (F,55,3), ``trans``                AMASS, SMPL-X                               z
    ``poses`` (F,72) or (F,24,3), ``trans``                 SMPL                                        y
    ``poses`` (F,66) or (F,22,3), ``trans``                 SMPL's body without hands                   y
    ``pose_body | body_pose`` (F,63 | 69), ``root_orient |  SMPL without its root                       y
    global_orient``, ``trans | transl``
    ``poses | poses_all``, ``Rh``, ``Th`` (or ``…_all``)    EasyMocap: turned about the origin          z
    ``poses`` (F,3J) and ``joint_names`` (J)                any; what :func:`motion.save_motion` writes  y
    ======================================================  ==========================================  ====

    ``up_axis`` ("y" or "z") in the file overrides the column *up*. Frame rate: ``mocap_framerate``,
    ``mocap_frame_rate`` or ``fps``; without one, 60 is assumed and noted.

    Args:
        joint_names: the joints of the columns, for a file whose place says so (a capture's motion).

    Raises:
        InputError: for anything else, and for numbers that cannot be a person's motion, naming the frame.
    """
    with Npz(path, what="motion") as archive:
        notes: list[str] = []
        easymocap = archive.first_of("Rh", "Rh_all") is not None
        axis_angles = _axis_angles(archive, notes, joint_names)
        names = _names(archive, axis_angles, joint_names)
        _check_angles(axis_angles, names, path)
        rotations = axis_angle_to_matrix(axis_angles)
        named = joint_names is not None or "joint_names" in archive.names
        amass = len(names) in (52, 55) and not named
        smpl_root = SMPLX_REST_ROOT if len(names) == 55 else SMPL_REST_ROOT
        if easymocap:
            turn = axis_angle_to_matrix(_per_frame(archive, "Rh", "Rh_all", frames=len(rotations)))
            rotations[:, 0] = turn @ rotations[:, 0]
            # Rh turns about the origin: transl = Th + R·J0 − J0
            shift = turn @ smpl_root - smpl_root
            translations = _per_frame(archive, "Th", "Th_all", frames=len(rotations)) + shift
        elif archive.first_of("trans", "transl") is not None:
            translations = _per_frame(archive, "trans", "transl", frames=len(rotations))
        else:
            notes.append("no trans in the file: the root stays in place")
            translations = np.zeros((len(rotations), 3))
        _check_translations(translations, path)
        if "betas" in archive.names:
            notes.append("the file's betas are ignored: the avatar keeps its own shape")
        fps = _frame_rate(archive, notes)
        up = _up_axis(archive, default="z" if amass or easymocap else "y")
        rest_root = smpl_root if amass or easymocap else None
        return MotionRecord(rotations, translations, rest_root, names, fps, up, tuple(notes))


def _axis_angles(archive: Npz, notes: list[str], joint_names: tuple[str, ...] | None) -> Floats:
    """[F, J, 3] rad with the root first, from whichever member holds the poses."""
    member = archive.first_of("poses", "poses_all", "pose_body", "body_pose")
    if member is None:
        raise InputError(
            "motion",
            expected="a member called poses, poses_all, pose_body or body_pose",
            got=", ".join(archive.names) or "an empty archive",
            file=archive.path,
        )
    poses = archive.numbers(member)
    shape = poses.shape
    flat, by_joint = len(shape) == 2 and shape[1] % 3 == 0, len(shape) == 3 and shape[2] == 3
    if not (flat or by_joint):
        got = "×".join(map(str, shape)) or "a single number"
        raise InputError(f"shape of {member}", expected="F×3J or F×J×3", got=got, file=archive.path)
    if shape[0] == 0:
        raise InputError(member, expected="at least one frame", got="none", file=archive.path)
    poses = poses.reshape(shape[0], shape[1] // 3 if flat else shape[1], 3)
    rootless = joint_names is None and "joint_names" not in archive.names and poses.shape[1] in (21, 23)
    if not rootless:
        return poses
    if archive.first_of("root_orient", "global_orient") is not None:
        root = _per_frame(archive, "root_orient", "global_orient", frames=len(poses))
    else:
        root = np.zeros((len(poses), 3))
        if archive.first_of("Rh", "Rh_all") is None:
            notes.append("no root orientation in the file: the root stays upright")
    return np.concatenate([root[:, None], poses], 1)


def _names(archive: Npz, axis_angles: Floats, given: tuple[str, ...] | None) -> tuple[str, ...]:
    count = axis_angles.shape[1]
    names = archive.strings("joint_names") if "joint_names" in archive.names else given
    if names is None:
        names = _NAMES_BY_COUNT.get(count)
        expected = "22, 24, 52 or 55 joints (66, 72, 156 or 165 columns), or joint_names beside them"
    else:
        expected = f"{len(names)} joints ({3 * len(names)} columns)"
    if names is None or len(names) != count:
        raise InputError(
            "joints of the motion",
            expected=expected,
            got=f"{count} joints ({3 * count} columns)",
            file=archive.path,
        )
    if len(set(names)) != count:
        raise InputError("joint_names", expected="each name once", got=", ".join(names), file=archive.path)
    return names


def _per_frame(archive: Npz, *members: str, frames: int) -> Floats:
    """[F, 3] of the first member present; (F, 1, 3) is how EasyMocap's users store it."""
    member = archive.first_of(*members)
    if member is None:
        raise InputError(f"{members[0]} is missing", got=", ".join(archive.names), file=archive.path)
    array = archive.numbers(member)
    if array.ndim == 3 and array.shape[1] == 1:
        array = array[:, 0]
    if array.shape != (frames, 3):
        got = "×".join(map(str, array.shape)) or "a single number"
        raise InputError(
            f"shape of {member}", expected=f"{frames}×3, as many frames as poses", got=got, file=archive.path
        )
    return array


def _check_angles(axis_angles: Floats, names: tuple[str, ...], path: str | Path) -> None:
    angles = np.linalg.norm(axis_angles, axis=-1)
    if angles.max() > _MAX_ANGLE:
        frame, joint = np.argwhere(angles > _MAX_ANGLE)[0]
        raise InputError(
            f"poses: {names[joint]}",
            expected=f"an axis-angle of at most {_MAX_ANGLE:g} rad",
            got=f"{angles[frame, joint]:g}",
            file=path,
            frame=int(frame),
            hint="are these degrees?",
        )


def _check_translations(translations: Floats, path: str | Path) -> None:
    distances = np.abs(translations).max(-1)
    if distances.max() > _MAX_DISTANCE:
        frame = int(np.argmax(distances > _MAX_DISTANCE))
        raise InputError(
            "trans",
            expected=f"metres, at most {_MAX_DISTANCE:g} from the origin",
            got=f"{distances[frame]:g}",
            file=path,
            frame=frame,
            hint="are these millimetres?",
        )


def _frame_rate(archive: Npz, notes: list[str]) -> float:
    member = archive.first_of("mocap_framerate", "mocap_frame_rate", "fps")
    if member is None:
        notes.append(f"no frame rate in the file: {_DEFAULT_FPS:g} frames per second assumed")
        return _DEFAULT_FPS
    value = archive.numbers(member)
    if value.size != 1 or not 0 < value.item() <= 10_000:
        raise InputError(
            member,
            expected="frames per second, above 0",
            got=value.reshape(-1)[:4].tolist(),
            file=archive.path,
        )
    return float(value.item())


def _up_axis(archive: Npz, *, default: str) -> str:
    if "up_axis" not in archive.names:
        return default
    up = "".join(archive.strings("up_axis")).lower()
    if up not in ("y", "z"):
        raise InputError("up_axis", expected="y or z", got=up, file=archive.path)
    return up
