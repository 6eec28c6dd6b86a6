"""Biovision's BVH."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

from .tree import Floats, MocapTree, about_axis, check_size, unique_names

_ROUNDED_FPS = 2e-4  # relative distance to a whole number: more than of 1 / 0.0083333, less than of 29.97

_STILL = 1e-3  # of the longest bone: positions of joints below the root that differ less are constant


@dataclass
class _Joint:
    name: str
    parent: int
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    channels: tuple[str, ...] = ()
    end: Floats | None = None


def read_bvh(path: str | Path) -> MocapTree:
    """Read a BVH file: rotations in degrees, multiplied in the order of their channels.

    Raises:
        InputError: it is not one, is truncated, or has non-finite or too large numbers.
    """
    path = existing_file(path, what="motion")
    try:
        return _read(iter(_text(path.read_bytes()).split()))
    except StopIteration as error:
        raise InputError("BVH file", expected="HIERARCHY and MOTION", got="an end before", file=path) from error
    except ValueError as error:
        raise InputError("BVH file", expected="numbers", got=str(error), file=path) from error
    except InputError as error:
        raise error.at(file=path) from error


def _read(words: Iterator[str]) -> MocapTree:
    joints = _hierarchy(words)
    frames, seconds, values = _motion(words, sum(len(joint.channels) for joint in joints))
    rotations = np.tile(np.eye(3), (frames, len(joints), 1, 1))
    positions = np.tile([joint.offset for joint in joints], (frames, 1, 1))
    positions[:, 0] = 0
    column = 0
    for number, joint in enumerate(joints):
        for channel in joint.channels:
            axis = "XYZ".index(channel[0])
            if channel[1:] == "rotation":
                rotations[:, number] = rotations[:, number] @ about_axis(axis, np.radians(values[:, column]))
            else:
                positions[:, number, axis] = values[:, column]
            column += 1
    names = unique_names([joint.name for joint in joints])
    parents = tuple(joint.parent for joint in joints)
    offsets = np.array([joint.offset for joint in joints])
    ends = {number: joint.end for number, joint in enumerate(joints) if joint.end is not None}
    moves = _moves(offsets, positions)
    return MocapTree(names, parents, offsets, rotations, positions[:, 0], _rounded(1 / seconds), (), ends, moves)


def _moves(offsets: Floats, positions: Floats) -> dict[int, Floats]:
    """``positions`` [F, 3] of joints below the root that move in their parent's frame, as hips below a fixed root.

    They replace the offset, or add to it where they are about zero. Channels that stay constant say nothing.
    """
    still = _STILL * np.linalg.norm(offsets, axis=-1).max()
    moves = {}
    for joint in np.flatnonzero(np.ptp(positions, axis=0).max(-1) > still):
        usual = np.median(positions[:, joint], axis=0)
        added = np.linalg.norm(usual) < np.linalg.norm(usual - offsets[joint])
        if joint:
            moves[int(joint)] = positions[:, joint] + added * offsets[joint]
    return moves


def _hierarchy(words: Iterator[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    open_joints: list[int] = []  # −1 for an end site
    if next(words) != "HIERARCHY":
        raise InputError("BVH file", expected="HIERARCHY first")
    while True:
        word = next(words)
        if word in ("ROOT", "JOINT"):
            name = next(words)
            while (more := next(words)) != "{":  # names with spaces
                name += f" {more}"
            if joints and not open_joints:
                raise InputError("BVH hierarchy", expected="one ROOT", got=f"{joints[0].name} and {name}")
            joints.append(_Joint(name, open_joints[-1] if open_joints else -1))
            open_joints.append(len(joints) - 1)
        elif word == "End" and open_joints:
            while next(words) != "{":
                pass
            open_joints.append(-1)
        elif word == "OFFSET" and open_joints:
            offset = np.array([float(next(words)) for _ in range(3)])
            if not np.isfinite(offset).all():
                raise InputError("OFFSET", expected="finite numbers", got=offset.tolist())
            check_size("OFFSET", offset.tolist())
            if open_joints[-1] >= 0:
                joints[open_joints[-1]].offset = offset
            elif len(open_joints) > 1:
                joints[open_joints[-2]].end = offset
        elif word == "CHANNELS" and open_joints:
            names = tuple([next(words).capitalize() for _ in range(int(next(words)))])
            known = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
            if not set(names) <= known:
                raise InputError("channels", expected=", ".join(sorted(known)), got=", ".join(names))
            joints[open_joints[-1]].channels = names
        elif word == "}" and open_joints:
            open_joints.pop()
        elif word == "MOTION" and joints and not open_joints:
            return joints
        else:
            raise InputError("BVH hierarchy", expected="ROOT, JOINT, OFFSET, CHANNELS or }", got=word)


def _motion(words: Iterator[str], channels: int) -> tuple[int, float, Floats]:
    frames, seconds = int(_after("Frames", words)), float(_after("Frame Time", words))
    values = np.array([float(word) for word in words])
    if channels == 0:
        raise InputError("channels", expected="at least one", got="none")
    if frames < 1:
        raise InputError("Frames", expected="at least one", got=frames)
    if values.size != frames * channels:
        raise InputError("BVH motion", expected=f"{frames} frames of {channels} numbers", got=values.size)
    if not 1e-4 <= seconds <= 10:
        raise InputError("Frame Time", expected="seconds, 0.0001 to 10", got=seconds)
    values = values.reshape(frames, channels)
    finite = np.isfinite(values).all(1)
    if not finite.all():
        raise InputError("BVH motion", expected="finite numbers", frame=int(np.argmin(finite)))
    frame = int(np.abs(values).max(1).argmax())
    check_size("BVH motion", values[frame].tolist(), frame)
    return frames, seconds, values


def _after(label: str, words: Iterator[str]) -> str:
    """The word after ``label`` and a colon, with or without spaces around it."""
    head, wanted = "", label.replace(" ", "") + ":"
    while len(head) < len(wanted):
        head += next(words)
    if not head.startswith(wanted):
        raise InputError("BVH motion", expected="Frames: … Frame Time: …", got=head)
    return head[len(wanted) :] or next(words)


def _text(content: bytes) -> str:
    """UTF-8, or UTF-16 by its mark or zeros, as some programs of Windows save a text."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace")
    if b"\0" in content[:2]:
        return content.decode("utf-16-be" if content[0] == 0 else "utf-16-le", errors="replace")
    return content.decode("utf-8-sig", errors="replace")


def _rounded(fps: float) -> float:
    """``fps`` without the rounding of the file's seconds."""
    return float(round(fps)) if abs(round(fps) - fps) < _ROUNDED_FPS * fps else fps
