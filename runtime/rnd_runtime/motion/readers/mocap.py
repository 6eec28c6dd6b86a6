"""Motion-capture files with a skeleton of their own: BVH, and Acclaim's ASF with AMC."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.rotations import axis_angle_to_matrix

Floats = NDArray[np.float64]

_ACCLAIM_FPS = 120.0  # CMU's; the format has no place for it
_MOST = 1e6  # degrees, or lengths in whatever unit: what is larger overflows further on
_WHOLE_FPS = 2e-4  # share by which 1 / 0.0083333 may miss a whole number: less than 29.97 misses 30


@dataclass(frozen=True, eq=False)
class MocapTree:
    """A recorded skeleton in its file's own units and axes.

    Attributes:
        names: J joint names, each once, the root first.
        parents: [J], −1 for the root, a parent before its children.
        offsets: [J, 3] from the parent in the zero pose, in which every rotation is the identity.
        rotations: [F, J, 3, 3] local, on top of the zero pose.
        root_positions: [F, 3].
        fps: frames per second.
        notes: what was assumed or left out.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Floats
    rotations: Floats
    root_positions: Floats
    fps: float
    notes: tuple[str, ...] = ()

    def global_rotations(self) -> Floats:
        """[F, J, 3, 3] of the joints in the file's world."""
        turned = self.rotations.copy()
        for joint, parent in enumerate(self.parents[1:], 1):
            turned[:, joint] = turned[:, parent] @ self.rotations[:, joint]
        return turned

    def zero_positions(self) -> Floats:
        """[J, 3] of the joints in the zero pose, the root at the origin."""
        positions = np.zeros((len(self.names), 3))
        for joint, parent in enumerate(self.parents[1:], 1):
            positions[joint] = positions[parent] + self.offsets[joint]
        return positions

    def path(self, joint: int, turned: Floats) -> Floats:
        """[F, 3] where ``joint`` is in the file's world; ``turned``: ``global_rotations``."""
        path = self.root_positions
        while joint:
            parent = self.parents[joint]
            path = path + turned[:, parent] @ self.offsets[joint]
            joint = parent
        return path


@dataclass
class _Joint:
    name: str
    parent: int
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    channels: tuple[str, ...] = ()


# BVH


def read_bvh(path: str | Path) -> MocapTree:
    """Read a Biovision file: rotations in degrees, multiplied in the order of their channels.

    Raises:
        InputError: when it is not one, is cut short, or holds numbers that are not finite or beyond any use.
    """
    path = existing_file(path, what="motion")
    try:
        words = iter(path.read_text(encoding="utf-8-sig", errors="replace").split())
        joints = _bvh_hierarchy(words)
        frames, seconds, values = _bvh_motion(words, sum(len(joint.channels) for joint in joints))
    except StopIteration as error:
        raise InputError("BVH file", expected="HIERARCHY and MOTION", got="an end before", file=path) from error
    except ValueError as error:
        raise InputError("BVH file", expected="numbers", got=str(error), file=path) from error
    except InputError as error:
        raise error.at(file=path) from error
    rotations = np.tile(np.eye(3), (frames, len(joints), 1, 1))
    positions = np.tile([joint.offset for joint in joints], (frames, 1, 1))
    positions[:, 0] = 0
    column = 0
    for number, joint in enumerate(joints):
        for channel in joint.channels:
            axis = "XYZ".index(channel[0])
            if channel[1:] == "rotation":
                turn = _about_axis(axis, np.radians(values[:, column]))
                rotations[:, number] = rotations[:, number] @ turn
            else:
                positions[:, number, axis] = values[:, column]
            column += 1
    path_of_root, trunk = _carried(joints, rotations, positions)
    moving = [
        joint.name
        for number, joint in enumerate(joints)
        if number not in trunk and any(name.endswith("position") for name in joint.channels)
    ]
    notes = (f"positions of joints but the root are left out: {', '.join(moving[:3])}, …",) if moving else ()
    return _tree(joints, rotations, path_of_root, _whole(1 / seconds), notes, path)


def _carried(joints: list[_Joint], rotations: Floats, positions: Floats) -> tuple[Floats, list[int]]:
    """The root's path [F, 3] with what the only child of the only child ... moves beside its parent; and who they are.

    Many a tool writes the hips, and where they go, below a root of its own that stands still. ``positions``
    [F, J, 3] are the joints' own, in the frame of the parent; they take the place of the offset.
    """
    joint, trunk, path, turned = 0, [0], positions[:, 0], rotations[:, 0]
    while len(children := [k for k, child in enumerate(joints) if child.parent == joint]) == 1:
        (joint,) = children
        trunk.append(joint)
        path = path + np.einsum("fij,fj->fi", turned, positions[:, joint] - joints[joint].offset)
        turned = turned @ rotations[:, joint]
    return path, trunk


def _bvh_hierarchy(words: Iterator[str]) -> list[_Joint]:
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
            _check_size("OFFSET", offset.tolist())
            if open_joints[-1] >= 0:  # else of an end site, which is no joint
                joints[open_joints[-1]].offset = offset
        elif word == "CHANNELS" and open_joints:
            # a list first: in a generator the end of the file would be another error
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


def _bvh_motion(words: Iterator[str], channels: int) -> tuple[int, float, Floats]:
    header = [next(words) for _ in range(5)]  # Frames: N Frame Time: S
    if (header[0], header[2], header[3]) != ("Frames:", "Frame", "Time:"):
        raise InputError("BVH motion", expected="Frames: … Frame Time: …", got=" ".join(header))
    frames, seconds = int(header[1]), float(header[4])
    values = np.array([float(word) for word in words])
    if channels == 0:
        raise InputError("channels", expected="at least one", got="none")
    if frames < 1 or values.size != frames * channels:
        raise InputError("BVH motion", expected=f"{frames} frames of {channels} numbers", got=values.size)
    if not 1e-4 <= seconds <= 10:
        raise InputError("Frame Time", expected="seconds, 0.0001 to 10", got=seconds)
    values = values.reshape(frames, channels)
    finite = np.isfinite(values).all(1)
    if not finite.all():
        raise InputError("BVH motion", expected="finite numbers", frame=int(np.argmin(finite)))
    frame = int(np.abs(values).max(1).argmax())
    _check_size("BVH motion", values[frame].tolist(), frame)
    return frames, seconds, values


# Acclaim


def read_acclaim(path: str | Path) -> MocapTree:
    """Read an AMC motion with the ASF skeleton beside it.

    A bone here is a joint at the bone's start.

    Raises:
        InputError: when there is no such skeleton (``asf_beside``), or the files do not fit together.
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
    frames = _read_amc(path, bones)
    rotations = np.tile(np.eye(3), (len(frames), len(bones), 1, 1))
    positions = np.zeros((len(frames), 3))
    names = [bone.name for bone in bones]
    for number, bone in enumerate(bones):
        values = np.array([frame.get(bone.name, [0.0] * len(bone.freedoms)) for frame in frames])
        turn = np.tile(np.eye(3), (len(frames), 1, 1))
        for column, freedom in enumerate(bone.freedoms):
            if freedom == "l":  # bones keep their lengths
                continue
            axis = "xyz".index(freedom[1])
            if freedom[0] == "r":
                angle = np.radians(values[:, column]) if degrees else values[:, column]
                turn = _about_axis(axis, angle) @ turn
            elif number == 0:
                positions[:, axis] = values[:, column]
        rotations[:, number] = bone.axes @ turn @ bone.axes.T
    joints = [_Joint(bone.name, -1 if bone.parent is None else names.index(bone.parent)) for bone in bones]
    for joint in joints:
        if joint.parent >= 0:
            joint.offset = bones[joint.parent].reach
    notes = [f"no frame rate in the file: {_ACCLAIM_FPS:g} frames per second assumed, as CMU records"]
    if silent := [bone.name for bone in bones if bone.freedoms and bone.name not in frames[0]]:
        notes.append(f"bones that no frame has stay as the skeleton has them: {', '.join(silent)}")
    return _tree(joints, rotations, positions, _ACCLAIM_FPS, tuple(notes), path)


@dataclass
class _Bone:
    """``axes`` [3, 3] of its rotations, ``reach`` [3] from its start to its end."""

    name: str
    axes: Floats = field(default_factory=lambda: np.eye(3))
    reach: Floats = field(default_factory=lambda: np.zeros(3))
    freedoms: tuple[str, ...] = ()
    parent: str | None = None


def asf_beside(path: Path) -> Path:
    """The skeleton of the AMC ``path``: ``NAME.asf``, else ``SUBJECT.asf`` of a CMU name ``SUBJECT_TRIAL.amc``, else
    the folder's only one.
    """
    others = sorted(path.parent.glob("*.[aA][sS][fF]"))
    for stem in (path.stem, path.stem.rsplit("_", 1)[0]):
        if own := [candidate for candidate in others if candidate.stem == stem]:
            return own[0]
    if len(others) == 1:
        return others[0]
    existing_file(path, what="motion")  # of one that is not there, no skeleton is missing
    got = f"{len(others)} of other names" if others else "none"
    raise InputError("skeleton of the AMC", expected=f"{path.stem}.asf beside it", got=got, file=path)


_FREEDOMS = {"rx", "ry", "rz", "tx", "ty", "tz", "l"}


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
    _check_size(what, numbers)
    return numbers


def _axes(angles: Sequence[float], order: str, degrees: bool) -> Floats:
    """Rotations about fixed axes, the first of ``order`` first."""
    turn = np.eye(3)
    for angle, axis in zip(angles, order.lower()):
        turn = _about_axis("xyz".index(axis), np.array(np.radians(angle) if degrees else angle)) @ turn
    return turn


def _read_amc(path: Path, bones: list[_Bone]) -> list[dict[str, list[float]]]:
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
    """Refuse a frame without a bone that others have: a file that was cut short."""
    named = dict.fromkeys(bone for frame in frames for bone in frame)
    for number, frame in enumerate(frames):
        if lacking := [bone for bone in named if bone not in frame]:
            expected = "numbers, as other frames have"
            raise InputError(lacking[0], expected=expected, got="none", file=path, frame=number)


# Both


def _check_size(what: str, numbers: Sequence[float], frame: int | None = None) -> None:
    largest = max(map(abs, numbers), default=0.0)
    if largest > _MOST:
        raise InputError(what, expected=f"numbers of at most {_MOST:g}", got=f"{largest:g}", frame=frame)


def _about_axis(axis: int, angles: Floats) -> Floats:
    return axis_angle_to_matrix(angles[..., None] * np.eye(3)[axis])


def _whole(fps: float) -> float:
    """``fps`` without the rounding of the file's seconds."""
    return float(round(fps)) if abs(round(fps) - fps) < _WHOLE_FPS * fps else fps


def _tree(
    joints: list[_Joint], rotations: Floats, positions: Floats, fps: float, notes: tuple[str, ...], path: Path
) -> MocapTree:
    names = tuple(joint.name for joint in joints)
    if len(set(names)) != len(names) or any(
        not 0 <= joint.parent < number for number, joint in enumerate(joints) if number
    ):
        raise InputError("skeleton", expected="one tree, each name once", got=", ".join(names), file=path)
    return MocapTree(
        names,
        tuple(joint.parent for joint in joints),
        np.array([joint.offset for joint in joints]),
        rotations,
        positions,
        fps,
        notes,
    )
