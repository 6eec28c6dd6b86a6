"""Motions: local joint rotations and a root translation over time, in metres, Y up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import is_folder
from rnd_runtime.core.kinds import explained
from rnd_runtime.core.npz import save_npz
from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_runtime.motion.formats.recordings import Recording, folder_files, read_recording
from rnd_runtime.motion.formats.vectors import JointPaths
from rnd_runtime.motion.readers.arrays import MotionRecord, check_translations
from rnd_runtime.motion.readers.asf_amc import asf_beside

from .interpolation import interpolate_points, interpolate_rotations
from .joint_names import joints_of_map, load_joint_map, match_joints
from .limbs import Bones
from .retarget import Retargeted, retarget, retarget_tracks
from .skeleton import Skeleton, moving_joints
from .smpl import SMPL_REST_ROOT
from .solving.evidence import Tracks
from .standing import UP_ROTATIONS, up_axis

Floats = NDArray[np.float64]

Z_UP_TO_Y_UP: Floats = UP_ROTATIONS["z"]
"""(x, y, z) of a Z-up world → (x, z, −y)"""

# In files with fingers the index finger's base drives SMPL's joint of the hand, as in ml-hugs.
STAND_INS = {"left_hand": "left_index1", "right_hand": "right_index1"}

_PART_OF_A_FRAME = 1e-4  # tolerance of rounded durations and rates


@dataclass(frozen=True, eq=False)
class Motion:
    """F poses of J joints.

    Attributes:
        rotations: [F, J, 3, 3] local rotations relative to the rest pose, the root first.
        translations: [F, 3] m, added to the root's rest position.
        fps: frames per second; frame f is at f / fps seconds.
        joint_names: J names.
        source: origin, for messages.
        notes: assumptions and omissions of the reader, for the user.
        closed: whether the first frame follows the last.
        left_out: unused moving joints of the file, by its names.
    """

    rotations: Floats
    translations: Floats
    fps: float
    joint_names: tuple[str, ...]
    source: str = ""
    notes: tuple[str, ...] = ()
    closed: bool = False
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frames, joints = len(self.translations), len(self.joint_names)
        assert self.rotations.shape == (frames, joints, 3, 3), self.rotations.shape
        assert self.translations.shape == (frames, 3) and frames > 0, self.translations.shape
        assert self.fps > 0, self.fps
        for name in ("rotations", "translations"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float64))

    @property
    def frame_count(self) -> int:
        return len(self.translations)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last; of a closed motion to the first frame's return."""
        return (self.frame_count - (not self.closed)) / self.fps

    def frames_at(self, fps: float) -> int:
        """Number of frames at ``fps``; a closed motion repeats no pose."""
        if self.closed:
            return max(1, math.ceil(self.duration * fps - _PART_OF_A_FRAME))
        return math.floor(self.duration * fps + _PART_OF_A_FRAME) + 1

    def goes_round_at(self, fps: float) -> bool:
        """Whether it is closed and a whole number of frames long at ``fps``."""
        frames = self.duration * fps
        return self.closed and abs(frames - round(frames)) < _PART_OF_A_FRAME

    def loop_notes(self, fps: float) -> tuple[str, ...]:
        """A warning if it is closed and not a whole number of frames long at ``fps``."""
        if not self.closed or self.goes_round_at(fps):
            return ()
        even = max(round(self.duration * fps), 1) / self.duration
        what = f"the loop of {self.duration:.4g} s is no whole number of frames at {fps:g} per second"
        return (f"{what}: it jerks at the seam ({even:.9g} per second fit)",)

    def at(self, times_s: ArrayLike) -> Motion:
        """Poses at ``times_s`` [T] seconds, by ``.interpolation``; ``fps`` stays.

        Beyond its ends a motion keeps its end poses; a closed one repeats.
        """
        rotations, translations, positions = self.path_at(times_s)
        poses = interpolate_rotations(rotations, positions), interpolate_points(translations, positions)
        return replace(self, rotations=poses[0], translations=poses[1], closed=False)

    def path_at(self, times_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Rotations [F, J, 3, 3], translations [F, 3], and positions [T] in frames of the poses of ``at``."""
        positions = np.atleast_1d(np.asarray(times_s, np.float64)) * self.fps
        if self.closed:
            return *self._lap, 1 + positions % self.frame_count
        return self.rotations, self.translations, np.minimum(np.maximum(positions, 0), self.frame_count - 1)

    @cached_property
    def _lap(self) -> tuple[Floats, Floats]:
        """Rotations and translations of one cycle with one frame before and two after it, for the slopes."""
        frames = np.arange(-1, self.frame_count + 2) % self.frame_count
        return self.rotations[frames], self.translations[frames]


def load_motion(
    path: str | Path,
    skeleton: Skeleton,
    *,
    up: Literal["auto", "y", "z"] = "auto",
    fps: float | None = None,
    joint_names: tuple[str, ...] | None = None,
    joint_map: str | Path | None = None,
) -> Motion:
    """Read a motion file for ``skeleton``, Y up.

    Arrays (``readers.arrays``): joints are matched by name. The first joint is the root, or rotates it if unknown.
    Missing joints stay at rest and are noted; joints that ``skeleton`` lacks are left out. Z-up files are of the SMPL
    family, with the pelvis at ``J0 + trans``, J0 of SMPL's mean body. In Y-up files ``trans`` is an offset from the
    avatar's rest position, unless their layout differs. BVH and AMC have their own skeleton: ``retarget``.

    Args:
        up: the file's up axis; "auto" uses the layout and the file's ``up_axis``.
        fps: overrides the file's frame rate.
        joint_names: names of the columns.
        joint_map: a file of the avatar's joints' names in the motion: ``joint_names.load_joint_map``.

    Raises:
        InputError: with the file, the field and, where there is one, the frame.
    """
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise InputError("fps", expected="a positive number", got=fps)
    try:
        recording = read_recording(path, joint_names)
        if isinstance(recording, Recording):
            motion = _load_recording(recording, path, skeleton, up, joint_map)
        elif isinstance(recording, JointPaths):
            motion = _load_positions(recording, path, skeleton, up)
        else:
            motion = _load_arrays(recording, path, skeleton, up, joint_map)
    except InputError as error:
        raise explained(error, path, "motion") from error
    if fps is None:
        return motion
    notes = tuple(note for note in motion.notes if "frame rate" not in note)
    return replace(motion, fps=float(fps), notes=notes)


def motion_inputs(path: str | Path) -> list[Path]:
    """The files that ``load_motion`` reads of ``path``: itself, an .amc with its .asf, a folder's files.

    Raises:
        InputError: for an .amc without a skeleton.
    """
    path = Path(path)
    if is_folder(path):
        return folder_files(path)
    return [path, asf_beside(path)] if path.suffix.lower() == ".amc" else [path]


def _matched(
    names: Sequence[str], skeleton: Skeleton, joint_map: str | Path | None, bones: Bones | None = None
) -> dict[str, int]:
    table = None if joint_map is None else load_joint_map(joint_map)
    return match_joints(names, skeleton.names, table, joint_map, bones)


def _load_recording(
    recording: Recording, path: str | Path, skeleton: Skeleton, up: str, joint_map: str | Path | None
) -> Motion:
    tree = recording.tree
    if recording.matched is None:
        matched = _matched(tree.names, skeleton, joint_map, Bones(tree.parents, tree.offsets))
    else:
        by_user = {} if joint_map is None else joints_of_map(joint_map, tree.names, skeleton.names)
        named = {**recording.matched, **by_user}
        matched = {name: index for name, index in named.items() if name in skeleton.names}
    moved = retarget(tree, skeleton, matched, up)
    return _retargeted(moved, len(tree.rotations), tree.fps, path, skeleton)


def _load_positions(paths: JointPaths, path: str | Path, skeleton: Skeleton, up: str) -> Motion:
    points = {name: paths.positions[:, k] for k, name in enumerate(paths.names)}
    moved = retarget_tracks(Tracks(points, fps=paths.fps), skeleton, up)
    moved = replace(moved, notes=(*paths.notes, *moved.notes))
    return _retargeted(moved, len(paths.positions), paths.fps, path, skeleton)


def _retargeted(moved: Retargeted, frames: int, fps: float, path: str | Path, skeleton: Skeleton) -> Motion:
    first = frames - len(moved.rotations)
    finite = np.isfinite(moved.rotations).all((1, 2, 3)) & np.isfinite(moved.translations).all(1)
    if not finite.all():
        got = "others after retargeting"
        raise InputError("motion", expected="finite numbers", got=got, frame=first + int(np.argmin(finite)))
    check_translations(moved.translations, path, first)
    names, notes = skeleton.names, moved.notes
    return Motion(moved.rotations, moved.translations, fps, names, str(path), notes, left_out=moved.left_out)


def _load_arrays(
    record: MotionRecord, path: str | Path, skeleton: Skeleton, up: str, joint_map: str | Path | None
) -> Motion:
    names = list(record.joint_names)
    if joint_map is not None:
        matched = _matched(names, skeleton, joint_map)
        names = ["" if name in matched else name for name in names]
        for ours, column in matched.items():
            names[column] = ours
    rotations, used, notes = _match_joints(record.rotations, tuple(names), skeleton, path)
    left_out = tuple(record.joint_names[k] for k in np.flatnonzero(moving_joints(record.rotations)) if k not in used)
    axis, found = _up_of(record, rotations[:, 0], up)
    translations, rest_root = record.translations, record.rest_root
    if axis != "y" and rest_root is None:
        rest_root = SMPL_REST_ROOT
    if rest_root is not None:
        world = UP_ROTATIONS[axis]
        rotations[:, 0] = world @ rotations[:, 0]
        translations = (rest_root + translations) @ world.T - skeleton.rest_joints[0]
    notes = record.notes + found + notes
    return Motion(rotations, translations, record.fps, skeleton.names, str(path), notes, left_out=left_out)


def _up_of(record: MotionRecord, root: Floats, up: str) -> tuple[str, tuple[str, ...]]:
    """The up axis of the file, and notes: ``up`` unless "auto", what the file states, or how the trunk stands."""
    if up != "auto":
        return up, ()
    if record.up_stated:
        return record.up, ()
    rest_root = SMPL_REST_ROOT if record.rest_root is None else record.rest_root
    return up_axis(root[:, :, 1], rest_root + record.translations, record.up)


def save_motion(path: str | Path, motion: Motion) -> None:
    """Write ``motion`` as an AMASS-like .npz that ``load_motion`` reads for any skeleton.

    Members: ``poses`` (F, 3J) axis-angle rad, ``trans`` (F, 3) m, ``mocap_framerate``, ``joint_names``, ``up_axis`` y.
    """
    save_npz(
        path,
        {
            "poses": matrix_to_axis_angle(motion.rotations).reshape(motion.frame_count, -1),
            "trans": motion.translations,
            "mocap_framerate": np.array(motion.fps, np.float64),
            "joint_names": np.array(motion.joint_names),
            "up_axis": np.array("y"),
        },
    )


def _match_joints(
    rotations: Floats, names: tuple[str, ...], skeleton: Skeleton, path: str | Path
) -> tuple[Floats, set[int], tuple[str, ...]]:
    """``rotations`` [F, ·, 3, 3] of ``names`` in the order of ``skeleton``, their columns, and notes."""
    columns = {name: column for column, name in enumerate(names)}
    for hand, finger in STAND_INS.items():
        if hand not in columns and finger in columns:
            columns[hand] = columns[finger]
    columns.setdefault(skeleton.names[0], 0)  # the root by any name
    matched = [name in columns for name in skeleton.names]
    if sum(matched) < min(2, len(skeleton)):
        raise InputError(
            "joints of the motion",
            expected=f"some of the avatar's ({', '.join(skeleton.names[:4])}, …)",
            got=f"{', '.join(names[:4])}, …",
            file=path,
        )
    result = np.broadcast_to(np.eye(3), (len(rotations), len(skeleton), 3, 3)).copy()
    for joint, name in enumerate(skeleton.names):
        if name in columns:
            result[:, joint] = rotations[:, columns[name]]
    used = {columns[name] for name in skeleton.names if name in columns}
    notes = []
    if 0 not in used and moving_joints(rotations)[0]:  # an unmatched joint above all others
        used.add(0)
        result[:, 0] = rotations[:, 0] @ result[:, 0]
        notes.append(f"{names[0] or 'the first joint'}, above {skeleton.names[0]}, rotates all below it")
    missing = [name for name, found in zip(skeleton.names, matched) if not found]
    if missing:
        notes.append(f"joints that the motion lacks stay at rest: {', '.join(missing)}")
    return result, used, tuple(notes)
