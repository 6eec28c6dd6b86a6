"""Acclaim's AMC motions with their ASF skeletons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

from .tree import Floats, MocapTree, about_axis, check_size

_FPS = 120.0  # CMU's; the format has no frame rate
_FREEDOMS = {"rx", "ry", "rz", "tx", "ty", "tz", "l"}


def read_amc(path: str | Path) -> MocapTree:
    """Read an AMC motion with the ASF skeleton beside it; a joint is at a bone's start.

    Raises:
        InputError: there is no skeleton (``asf_beside``), or the files do not match.
    """
    path = existing_file(path, what="motion")
    skeleton = asf_beside(path)
    try:
        bones, degrees = _read_asf(skeleton)
    except (ValueError, IndexError, KeyError, StopIteration) as error:
        got = f"{type(error).__name__} {error}"
        raise InputError("skeleton", expected="an Acclaim skeleton", got=got, file=skeleton) from error
    except InputError as error:
        raise error.at(file=skeleton) from error
    frames = _amc_frames(path, bones)
    rotations = np.tile(np.eye(3), (len(frames), len(bones), 1, 1))
    positions = np.zeros((len(frames), 3))
    names = [bone.name for bone in bones]
    for number, bone in enumerate(bones):
        values = np.array([frame.get(bone.name, [0.0] * len(bone.freedoms)) for frame in frames])
        rotation = np.tile(np.eye(3), (len(frames), 1, 1))
        for column, freedom in enumerate(bone.freedoms):
            if freedom == "l":  # bones keep their lengths
                continue
            axis = "xyz".index(freedom[1])
            if freedom[0] == "r":
                angle = np.radians(values[:, column]) if degrees else values[:, column]
                rotation = about_axis(axis, angle) @ rotation
            elif number == 0:
                positions[:, axis] = values[:, column]
        rotations[:, number] = bone.axes @ rotation @ bone.axes.T
    notes = [f"no frame rate in the file: {_FPS:g} frames per second assumed, as CMU records"]
    if silent := [bone.name for bone in bones if bone.freedoms and bone.name not in frames[0]]:
        notes.append(f"bones that no frame has stay as the skeleton has them: {', '.join(silent)}")
    parents = [-1 if bone.parent is None else names.index(bone.parent) for bone in bones]
    offsets = np.array([bones[parent].reach if parent >= 0 else np.zeros(3) for parent in parents])
    try:
        return MocapTree(tuple(names), tuple(parents), offsets, rotations, positions, _FPS, tuple(notes))
    except InputError as error:
        raise error.at(file=skeleton) from error


@dataclass
class _Bone:
    """``axes`` [3, 3] of its rotations, ``reach`` [3] from its start to its end."""

    name: str
    axes: Floats = field(default_factory=lambda: np.eye(3))
    reach: Floats = field(default_factory=lambda: np.zeros(3))
    freedoms: tuple[str, ...] = ()
    parent: str | None = None


def asf_beside(path: Path) -> Path:
    """The AMC's skeleton: ``NAME.asf``, ``SUBJECT.asf`` of CMU's ``SUBJECT_TRIAL.amc``, or the folder's only one."""
    others = sorted(path.parent.glob("*.[aA][sS][fF]"))
    for stem in (path.stem, path.stem.rsplit("_", 1)[0]):
        if own := [candidate for candidate in others if candidate.stem == stem]:
            return own[0]
    if len(others) == 1:
        return others[0]
    existing_file(path, what="motion")  # refuses a missing motion first
    got = f"{len(others)} of other names" if others else "none"
    raise InputError("skeleton of the AMC", expected=f"{path.stem}.asf beside it", got=got, file=path)


def _read_asf(path: Path) -> tuple[list[_Bone], bool]:
    """Bones with parents first, and whether angles are in degrees."""
    sections: dict[str, list[list[str]]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split("#")[0].replace("(", " ").replace(")", " ").split()
        if words and words[0].startswith(":"):
            sections[words[0][1:].lower()] = [words[1:]]
        elif words and sections:
            sections[next(reversed(sections))].append(words)
    units = {words[0]: words[1] for words in sections.get("units", []) if len(words) > 1}
    degrees = units.get("angle", "deg").lower().startswith("deg")
    root_lines = {words[0].lower(): words[1:] for words in sections["root"] if words}
    root = _Bone("root", freedoms=tuple(word.lower() for word in root_lines["order"]))
    orientation = _three(root_lines.get("orientation", ["0", "0", "0"]))
    root.axes = _axes(orientation, root_lines.get("axis", ["XYZ"])[0], degrees)
    bones = {"root": root}
    bone = root
    for words in sections["bonedata"]:
        key, rest = (words[0].lower(), words[1:]) if words else ("", [])
        if key == "name":
            bone = bones[rest[0]] = _Bone(rest[0])
        elif key == "direction":
            bone.reach = np.array(_three(rest))
        elif key == "length":
            bone.reach = bone.reach / max(float(np.linalg.norm(bone.reach)), 1e-12) * _finite(rest[:1])[0]
        elif key == "axis":
            bone.axes = _axes(_three(rest), rest[3], degrees)
        elif key == "dof":
            bone.freedoms = tuple(word.lower() for word in rest)
    for bone in bones.values():
        if wrong := set(bone.freedoms) - _FREEDOMS:
            raise ValueError(f"freedom {min(wrong)} of {bone.name}")
    ordered = [root]
    for words in sections["hierarchy"]:
        if words and words[0] in bones and words[0] not in ("begin", "end"):
            for child in words[1:]:
                bones[child].parent = words[0]
                ordered.append(bones[child])
    reached = {bone.name for bone in ordered}
    if apart := [bone.name for bone in ordered if bone.parent not in (None, *reached)]:
        raise ValueError(f"{apart[0]} that no line of the hierarchy joins to the root")
    return ordered, degrees


def _three(words: Sequence[str]) -> list[float]:
    if len(words) < 3:
        raise ValueError(f"{len(words)} numbers of three: {' '.join(words)}")
    return _finite(words[:3])


def _finite(words: Sequence[str], what: str = "skeleton") -> list[float]:
    numbers = [float(word) for word in words]
    if not np.isfinite(numbers).all():
        raise ValueError(f"not finite: {' '.join(words)}")
    check_size(what, numbers)
    return numbers


def _axes(angles: Sequence[float], order: str, degrees: bool) -> Floats:
    """Rotations about fixed axes, the first of ``order`` first."""
    rotation = np.eye(3)
    for angle, axis in zip(angles, order.lower()):
        rotation = about_axis("xyz".index(axis), np.radians(angle) if degrees else angle) @ rotation
    return rotation


def _amc_frames(path: Path, bones: list[_Bone]) -> list[dict[str, list[float]]]:
    counts = {bone.name: len(bone.freedoms) for bone in bones}
    frames: list[dict[str, list[float]]] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if not words or words[0][0] in "#:":
            continue
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
            continue
        if not frames:
            raise InputError("AMC motion", expected="a frame's number before its bones", got=words[0], file=path)
        bone, number = words[0], len(frames) - 1
        try:
            values = _finite(words[1:], bone)
        except ValueError as error:
            raise InputError(bone, expected="finite numbers", got=str(error), file=path, frame=number) from error
        except InputError as error:
            raise error.at(file=path, frame=number) from error
        if counts.get(bone) != len(values):
            expected = f"{counts[bone]} numbers" if bone in counts else "a bone of the skeleton"
            raise InputError(bone, expected=expected, got=len(values), file=path, frame=number)
        frames[-1][bone] = values
    if not frames:
        raise InputError("AMC motion", expected="at least one frame", got="none", file=path)
    _check_whole(frames, path)
    return frames


def _check_whole(frames: list[dict[str, list[float]]], path: Path) -> None:
    """Refuse a truncated file: a frame without a bone that others have."""
    named = dict.fromkeys(bone for frame in frames for bone in frame)
    for number, frame in enumerate(frames):
        if lacking := [bone for bone in named if bone not in frame]:
            expected = "numbers, as other frames have"
            raise InputError(lacking[0], expected=expected, got="none", file=path, frame=number)
