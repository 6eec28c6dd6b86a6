"""Motions as named arrays of known layouts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.smpl import NAMES_BY_COUNT, SMPL_REST_ROOT, SMPLX_REST_ROOT

Floats = NDArray[np.float64]

POSES = ("poses", "poses_all", "pose_body", "body_pose")
"""Members that hold rotations"""
# Members of AMASS' SMPL-X files alone, beside the split poses
_AMASS_MEMBERS = ("surface_model_type", "mocap_frame_rate", "mocap_framerate", "mocap_time_length")
_MAX_ANGLE = 100.0  # rad, beyond what fits contain
_MANY_BEYOND_A_TURN = 0.2  # share of rotations; half of all in degrees, 1/22 with a spinning root
_MAX_DISTANCE = 1000.0  # m; more suggests millimetres
_MAX_HEIGHT, _MAX_SPEED = 30.0, 20.0  # m, m/s, of the median frame: a sprinter has 12 m/s
_TIMES = ("times", "timestamps")
_ORDERS = (*_TIMES, "frame_ids", "frame_id")
_FPS_OF_TIMES = (5.0, 1000.0)  # else they are no seconds
_UNEVEN = 0.5  # of a frame, largest difference of steps in time
_DEFAULT_FPS = 60.0
_ORTHOGONAL = 0.02  # largest element of R Rᵀ − 1
FPS_LIMITS = (1e-3, 1e4)


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """Content of a motion file, in its axes.

    Attributes:
        rotations: [F, J, 3, 3] local rotations, the root first.
        translations: [F, 3] m, added to the root's rest position.
        rest_root: [3] m, the rest position that ``translations`` refers to; None for the avatar's own.
        joint_names: J names.
        fps: frames per second.
        up: the up axis, "y" or "z".
        up_stated: whether the file states it.
        notes: assumptions and omissions.
    """

    rotations: Floats
    translations: Floats
    rest_root: Floats | None
    joint_names: tuple[str, ...]
    fps: float
    up: str
    up_stated: bool
    notes: tuple[str, ...]


def read_arrays(
    members: Members,
    joint_names: tuple[str, ...] | None = None,
    rest_root: Floats | None = None,
    notes: tuple[str, ...] = (),
    up: str | None = None,
) -> MotionRecord:
    """Read a motion from arrays of a known layout.

    ======================================================  ==========================================  ====
    members                                                 joints                                      up
    ======================================================  ==========================================  ====
    ``poses`` (F,156) or (F,52,3), ``trans``                AMASS, SMPL-H                               z
    ``poses`` (F,165) or (F,55,3), ``trans``                AMASS, SMPL-X                               z
    ``root_orient``, ``pose_body`` (F,63), ``trans``,       AMASS, SMPL-X without ``poses``; fingers    z
    ``mocap_frame_rate``, ``pose_hand`` (F,90)?             where there are any
    ``poses`` (F,72) or (F,24,3), ``trans``                 SMPL                                        y
    ``poses`` (F,66) or (F,22,3), ``trans``                 SMPL's body without hands                   y
    ``pose_body | body_pose`` (F,63 | 69), ``root_orient |  SMPL without its root; fingers from         y
    global_orient``, ``trans | transl``                     ``left_hand_pose``, ``right_hand_pose``
    ``poses | poses_all``, ``Rh``, ``Th`` (or ``…_all``)    EasyMocap: rotates about the origin         z
    ``poses`` (F,3J) and ``joint_names`` (J)                any; what ``motion.save_motion`` writes  y
    ======================================================  ==========================================  ====

    ``poses`` may be rotation matrices (F,J,3,3). ``up_axis`` ("y" or "z") in the file overrides the column *up*.
    Frame rate: ``mocap_framerate``, ``mocap_frame_rate`` or ``fps``, else of ``times`` in seconds, else 60 with a note.

    Args:
        joint_names: the joints of the columns, for a file without names (a capture's motion).
        rest_root: [3] m, the rest position that translations refer to; by default the layout's.
        notes: of who found the members.
        up: the layout's up axis; by default that of the table.

    Raises:
        InputError: for anything else, and for numbers that cannot be a person's motion, naming the frame.
    """
    remarks = [*notes]
    easymocap = members.first_of("Rh", "Rh_all") is not None
    axis_angles = _axis_angles(members, remarks, joint_names)
    names = names_of_joints(members, axis_angles.shape[1], joint_names)
    _check_angles(axis_angles, names, members.path, remarks)
    rotations = axis_angle_to_matrix(axis_angles)
    named = joint_names is not None or "joint_names" in members.names
    split = "pose_body" in members.names and "poses" not in members.names
    whole = len(names) in (52, 55) and "poses" in members.names and not named
    amass = whole or (split and not named and members.first_of(*_AMASS_MEMBERS) is not None)
    smpl_x = len(names) == 55 or (split and amass)
    smpl_root = SMPLX_REST_ROOT if smpl_x else SMPL_REST_ROOT
    if easymocap:
        heading = axis_angle_to_matrix(_per_frame(members, "Rh", "Rh_all", frames=len(rotations)))
        rotations[:, 0] = heading @ rotations[:, 0]
        # Rh rotates about the origin: transl = Th + R·J0 − J0
        shift = heading @ smpl_root - smpl_root
        translations = _per_frame(members, "Th", "Th_all", frames=len(rotations)) + shift
    elif members.first_of("trans", "transl") is not None:
        translations = _per_frame(members, "trans", "transl", frames=len(rotations))
    else:
        remarks.append("no trans in the file: the root stays in place")
        translations = np.zeros((len(rotations), 3))
    check_translations(translations, members.path)
    if "betas" in members.names:
        remarks.append("the file's betas are ignored: the avatar keeps its own shape")
    _check_order(members, len(rotations))
    by_times = _rate_of_times(members, len(rotations), remarks)
    fps = frame_rate(members) or by_times
    if fps is None:
        remarks.append(f"no frame rate in the file: {_DEFAULT_FPS:g} frames per second assumed")
        fps = _DEFAULT_FPS
    stated = _up_axis(members)
    up = stated or up or ("z" if amass or easymocap else "y")
    if unit := _likely_unit(translations, fps, up):
        remarks.append(f"trans is higher or faster than a person in metres: these look like {unit}")
    if rest_root is None and (amass or easymocap):
        rest_root = smpl_root
    return MotionRecord(rotations, translations, rest_root, names, fps, up, stated is not None, tuple(remarks))


def _axis_angles(archive: Members, notes: list[str], joint_names: tuple[str, ...] | None) -> Floats:
    """Poses [F, J, 3] rad, the root first."""
    member = archive.first_of(*POSES)
    if member is None:
        raise InputError(
            "motion",
            expected=f"a member called {', '.join(POSES[:-1])} or {POSES[-1]}",
            got=", ".join(archive.names) or "an empty archive",
            file=archive.path,
        )
    poses = archive.numbers(member)
    if poses.ndim == 4 and poses.shape[2:] == (3, 3):
        poses = matrix_to_axis_angle(check_rotations(poses, member, archive.path))
    shape = poses.shape
    flat, by_joint = len(shape) == 2 and shape[1] % 3 == 0, len(shape) == 3 and shape[2] == 3
    if not (flat or by_joint):
        got = "×".join(map(str, shape)) or "a single number"
        raise InputError(f"shape of {member}", expected="F×3J, F×J×3 or F×J×3×3", got=got, file=archive.path)
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
    return np.concatenate([root[:, None], poses, *_fingers(archive, poses, notes)], 1)


def _fingers(archive: Members, body: Floats, notes: list[str]) -> list[Floats]:
    """Thirty finger joints [F, 30, 3] of a split ``body`` of 21 joints [F, 21, 3], if present."""
    if body.shape[1] != 21 or ("pose_hand" not in archive.names and "left_hand_pose" not in archive.names):
        return []
    sides = ("pose_hand",) if "pose_hand" in archive.names else ("left_hand_pose", "right_hand_pose")
    poses = [archive.numbers(side) for side in sides]
    if any(pose.ndim < 2 or len(pose) != len(body) or pose[0].size != 90 // len(sides) for pose in poses):
        notes.append("hands stay at rest: they are not given as 15 joints each")
        return []
    return [np.concatenate([pose.reshape(len(body), -1, 3) for pose in poses], 1)]


def names_of_joints(archive: Members, count: int, given: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Names of ``count`` joints: the file's, else ``given``, else in the SMPL family's order.

    Raises:
        InputError: no joints or names, another number of names, or a repeated name.
    """
    names = archive.strings("joint_names") if "joint_names" in archive.names else given
    if names is None:
        names = NAMES_BY_COUNT.get(count)
        expected = "22, 24, 52 or 55 joints (66, 72, 156 or 165 columns), or joint_names beside them"
    else:
        expected = f"{len(names)} joints ({3 * len(names)} columns)"
    if names is None or len(names) != count:
        raise InputError(
            "joints of the motion", expected=expected, got=f"{count} joints ({3 * count} columns)", file=archive.path
        )
    if count == 0:
        raise InputError("joints of the motion", expected="at least one", got="none", file=archive.path)
    if len(set(names)) != count:
        raise InputError("joint_names", expected="each name once", got=", ".join(names), file=archive.path)
    return names


def _per_frame(archive: Members, *members: str, frames: int) -> Floats:
    """[F, 3] of the first member present; (F, 1, 3) is accepted too."""
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


def check_rotations(matrices: Floats, name: str, path: str | Path) -> Floats:
    """``matrices`` [F, J, 3, 3]; ``InputError`` with the frame of the first that is no rotation."""
    if matrices.ndim != 4 or matrices.shape[-2:] != (3, 3) or not matrices.size:
        raise InputError(f"shape of {name}", expected="F×J×3×3", got="×".join(map(str, matrices.shape)), file=path)
    finite = np.asarray(np.isfinite(matrices).all((-2, -1)))
    checked = np.where(finite[..., None, None], matrices, 0)
    off = np.abs(checked @ np.swapaxes(checked, -1, -2) - np.eye(3)).max((-2, -1))
    good = finite & (off < _ORTHOGONAL) & (np.linalg.det(checked) > 0)
    if not good.all():
        frame, joint = np.argwhere(~good)[0]
        got = "others" if finite[frame, joint] else "no numbers"
        raise InputError(f"{name}: joint {joint}", expected="rotation matrices", got=got, file=path, frame=int(frame))
    return matrices


def _check_angles(axis_angles: Floats, names: tuple[str, ...], path: str | Path, notes: list[str]) -> None:
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
    beyond = float((angles > 2 * np.pi).mean())
    if beyond > _MANY_BEYOND_A_TURN:
        notes.append(f"{beyond:.0%} of the rotations are beyond a whole turn: are these degrees instead of radians?")


def check_translations(translations: Floats, path: str | Path, first: int = 0) -> None:
    """Raise ``InputError`` for a distant root; ``first``: the file's frame of ``translations[0]``."""
    distances = np.abs(translations).max(-1)
    if distances.max() > _MAX_DISTANCE:
        frame = int(np.argmax(distances > _MAX_DISTANCE))
        raise InputError(
            "trans",
            expected=f"metres, at most {_MAX_DISTANCE:g} from the origin",
            got=f"{distances[frame]:g}",
            file=path,
            frame=first + frame,
            hint="are these millimetres?",
        )


def _number_of_each(archive: Members, member: str, frames: int) -> Floats:
    """[F] of ``member``; [0] where it is missing or no number of each frame, as names of images."""
    try:
        values = archive.numbers(member) if member in archive.names else np.empty(0)
    except InputError:
        return np.empty(0)
    return values.reshape(-1) if values.size == frames else np.empty(0)


def _check_order(archive: Members, frames: int) -> None:
    """Raise ``InputError`` where the file's times or frame numbers do not increase from frame to frame."""
    for member in _ORDERS:
        values = _number_of_each(archive, member, frames)
        back = np.flatnonzero(np.diff(values) <= 0)
        if len(back):
            before, after = values[back[0] : back[0] + 2]
            raise InputError(
                member,
                expected="numbers that increase from frame to frame",
                got=f"{after:g} after {before:g}",
                file=archive.path,
                frame=int(back[0]) + 1,
                hint="sort the frames, and remove those that occur twice",
            )


def _likely_unit(translations: Floats, fps: float, up: str) -> str:
    """The unit of ``translations`` that are not a person's in metres; "" of those that may be."""
    heights = np.abs(translations[:, "xyz".index(up)])
    speeds = np.linalg.norm(np.diff(translations, axis=0), axis=1) * fps
    if (height := float(np.median(heights))) > _MAX_HEIGHT:
        return "centimetres" if height < 10 * _MAX_HEIGHT else "millimetres"
    return "millimetres or centimetres" if len(speeds) and np.median(speeds) > _MAX_SPEED else ""


def _rate_of_times(archive: Members, frames: int, notes: list[str]) -> float | None:
    """Frames per second of even times in seconds, after ``_check_order``; None without, with a note on uneven ones."""
    low, high = _FPS_OF_TIMES
    for member in _TIMES:
        steps = np.diff(_number_of_each(archive, member, frames))
        if not len(steps) or not low * (step := float(np.median(steps))) <= 1 <= high * step:
            continue
        if np.abs(steps - step).max() > _UNEVEN * step:
            notes.append(f"{member} are uneven: the frames are played one after the other")
        return round(1 / step, 3)
    return None


def frame_rate(archive: Members) -> float | None:
    """Frames per second, within ``FPS_LIMITS``; None where absent.

    Raises:
        InputError: another number, or several.
    """
    member = archive.first_of("mocap_framerate", "mocap_frame_rate", "fps")
    if member is None:
        return None
    value = archive.numbers(member)
    low, high = FPS_LIMITS
    if value.size != 1 or not low <= value.item() <= high:
        raise InputError(
            member,
            expected=f"frames per second, {low:g} to {high:g}",
            got=value.reshape(-1)[:4].tolist(),
            file=archive.path,
        )
    return float(value.item())


def _up_axis(archive: Members) -> str | None:
    if "up_axis" not in archive.names:
        return None
    up = "".join(archive.strings("up_axis")).lower()
    if up not in ("y", "z"):
        raise InputError("up_axis", expected="y or z", got=up, file=archive.path)
    return up
