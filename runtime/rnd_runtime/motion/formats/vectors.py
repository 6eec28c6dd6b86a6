"""Motions as one array without names: Motion-X' 322 columns, HumanML3D's 263, joint positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members
from rnd_runtime.motion.readers.arrays import POSES, frame_rate
from rnd_runtime.motion.readers.tracks import Track, video_track
from rnd_runtime.motion.smpl import NAMES_BY_COUNT, SMPLX_REST_ROOT

Floats = NDArray[np.float64]

_FPS = 20.0
_FPS_NOTE = f"no frame rate in the file: {_FPS:g} frames per second assumed, as HumanML3D has"
_PLACES = "joint positions without rotations: poses are fitted to them, and twists that they do not show are neutral"
_NAMES = ("joints", "joints3d", "joint_positions", "positions", "motion", "arr_0")
_UNITS = {1.0: "", 0.01: "centimetres", 0.001: "millimetres"}
_THIGH = (0.2, 0.8)  # m
_STEADY = 0.2  # largest deviation of a bone's length from its median, in most frames, of the median
_BONES = ((1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21))  # thighs, shins and arms


@dataclass(frozen=True, eq=False)
class JointPaths:
    """Positions of joints over time, in their file's axes.

    Attributes:
        names: J joint names, SMPL's.
        positions: [F, J, 3] m.
        fps: frames per second.
        notes: assumptions and omissions.
    """

    names: tuple[str, ...]
    positions: Floats
    fps: float
    notes: tuple[str, ...]


def is_mdm_result(content: Mapping[Any, Any]) -> bool:
    """Whether ``content`` is MDM's ``results.npy``: ``motion`` [N, 22, 3, F]."""
    shape = np.shape(content.get("motion", ()))
    return len(shape) == 4 and shape[1:3] in ((22, 3), (24, 3))


def mdm_result(content: Mapping[Any, Any], path: str | Path) -> JointPaths:
    """The first of MDM's motions, cut to its length."""
    motions = np.asarray(content["motion"], np.float64)
    frames = motions.shape[3]
    if "lengths" in content and np.size(content["lengths"]):
        frames = int(np.clip(np.reshape(content["lengths"], -1)[0], 1, frames))
    return _paths(motions[0, ..., :frames].transpose(2, 0, 1), path, one_of(len(motions)))


def is_named_vector(members: Members) -> bool:
    """Whether ``members`` are joint positions or HumanML3D's numbers by a usual name, without poses."""
    return members.first_of(*POSES) is None and members.first_of(*_NAMES) is not None


def named_vector(members: Members) -> Track | JointPaths:
    """``read_vector`` of ``members`` (``is_named_vector``), at their frame rate."""
    name, fps = members.first_of(*_NAMES), frame_rate(members)
    vector = read_vector(members.numbers(name or ""), members.path)
    if fps is None or not isinstance(vector, JointPaths):
        return vector
    return replace(vector, fps=fps, notes=tuple(note for note in vector.notes if note != _FPS_NOTE))


def read_vector(array: NDArray[Any], path: str | Path) -> Track | JointPaths:
    """The motion in ``array``.

    ================================  ==============================================================================
    [F, 322], [N, F, 322]             Motion-X: root 3, body 63, hands 90, jaw 3, face 150, trans 3, betas 10; SMPL-X
    [F, 263], [N, F, 263]             HumanML3D (MDM, MoMask, T2M-GPT): root velocities and height, 21 joints around
                                      it, their rotations, velocities, foot contacts. Positions are recovered; the
                                      rotations are those of least twist to the same positions
    [F, 22 | 24 | 52, 3], [N, …]      joint positions in SMPL's order; also with time last, [22 | 24, 3, F]
    ================================  ==============================================================================

    Raises:
        InputError: another shape, or positions of no person.
    """
    shape = "×".join(map(str, array.shape)) or "a single number"
    if array.dtype.kind not in "fiu" or not array.size:
        raise InputError("motion", expected="an array of numbers", got=f"{shape} of {array.dtype}", file=path)
    numbers = np.asarray(array, np.float64)
    if (infinite := np.argwhere(~np.isfinite(numbers))).size:
        raise InputError("motion", expected="finite numbers", got="others", file=path, frame=int(infinite[0][0]))
    notes: tuple[str, ...] = ()
    if numbers.ndim in (3, 4) and numbers.shape[-3] in (22, 24) and numbers.shape[-2] == 3 != numbers.shape[-1]:
        numbers = np.moveaxis(numbers, -1, -3)
    if (numbers.ndim == 3 and numbers.shape[2] in (263, 322)) or (numbers.ndim == 4 and numbers.shape[3] == 3):
        numbers, notes = numbers[0], one_of(len(numbers))
    if numbers.ndim == 2 and numbers.shape[1] == 322:
        return _motion_x(numbers, path, notes)
    if numbers.ndim == 2 and numbers.shape[1] == 263:
        return _paths(humanml_positions(numbers), path, notes, "HumanML3D's 263 numbers")
    if numbers.ndim == 3 and numbers.shape[2] == 3 and numbers.shape[1] in (22, 24, 52):
        return _paths(numbers, path, notes)
    expected = "F×322 (Motion-X), F×263 (HumanML3D), F×22×3 or F×24×3 (joint positions), or named members in an .npz"
    raise InputError("motion as one array", expected=expected, got=shape, file=path)


def humanml_positions(numbers: Floats) -> Floats:
    """Joint positions [F, 22, 3] m, Y up, of HumanML3D's ``numbers`` [F, 263].

    Columns: 0 half the heading's angle per frame, 1–2 the root's velocity in x and z per frame and 3 its height, all in
    the heading's axes, then 21 joints' positions from the root's place on the floor. Both velocities are of the frame
    before.
    """
    half = np.concatenate([[0.0], np.cumsum(numbers[:-1, 0])])
    cosine, sine = np.cos(2 * half), np.sin(2 * half)

    def to_world(x: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Rotated by minus the heading about Y."""
        wide = (slice(None), *(None,) * (x.ndim - 1))
        return cosine[wide] * x - sine[wide] * z, sine[wide] * x + cosine[wide] * z

    steps = np.concatenate([np.zeros((1, 2)), numbers[:-1, 1:3]])
    path = np.cumsum(np.stack(to_world(steps[:, 0], steps[:, 1]), -1), axis=0)
    joints = numbers[:, 4:67].reshape(-1, 21, 3)
    x, z = to_world(joints[..., 0], joints[..., 2])
    others = np.stack([x + path[:, :1], joints[..., 1], z + path[:, 1:]], -1)
    root = np.stack([path[:, 0], numbers[:, 3], path[:, 1]], -1)
    return np.concatenate([root[:, None], others], 1)


def _motion_x(numbers: Floats, path: str | Path, notes: tuple[str, ...]) -> Track:
    eyes = np.zeros((len(numbers), 6))
    poses = np.concatenate([numbers[:, :66], numbers[:, 156:159], eyes, numbers[:, 66:156]], 1)
    arrays = {"poses": poses, "trans": numbers[:, 309:312], "betas": numbers[0, 312:]}
    return video_track(arrays, path, SMPLX_REST_ROOT, (*notes, "Motion-X' expressions of the face are left out"))


def one_of(count: int) -> tuple[str, ...]:
    """A note on a file of several motions."""
    return () if count == 1 else (f"{count} motions in the file: the first is taken",)


def _paths(positions: Floats, path: str | Path, notes: tuple[str, ...], what: str = "joint positions") -> JointPaths:
    """``positions`` of a person, in metres.

    Raises:
        InputError: bones change their length, or are of nobody's.
    """
    finite = np.isfinite(positions).all((1, 2))
    if not finite.all():
        raise InputError(what, expected="finite numbers", got="others", file=path, frame=int(np.argmin(finite)))
    shape = "×".join(map(str, positions.shape))
    lengths = np.stack([np.linalg.norm(positions[:, a] - positions[:, b], axis=-1) for a, b in _BONES], -1)
    usual = np.median(lengths, 0)
    steady = np.mean(np.abs(lengths - usual) <= _STEADY * usual)
    thigh = float(usual[:2].mean())
    scale = next((scale for scale in _UNITS if _THIGH[0] <= scale * thigh <= _THIGH[1]), None)
    if steady < 0.9 or scale is None:
        hint = "HumanML3D's normalised numbers need its Std.npy and Mean.npy first" if "263" in what else None
        expected = f"bones of a person and of one length, as these are {shape} positions of joints without rotations"
        got = f"thighs of {lengths[:, :2].min():.2g} to {lengths[:, :2].max():.2g}"
        raise InputError(what, expected=expected, got=got, file=path, hint=hint)
    if scale != 1:
        notes += (f"joint positions look like {_UNITS[scale]}: taken for that",)
    names = NAMES_BY_COUNT[positions.shape[1]]
    return JointPaths(names, scale * positions, _FPS, (*notes, _FPS_NOTE, _PLACES))
