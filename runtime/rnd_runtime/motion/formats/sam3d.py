"""SAM 3D Body's results: the MHR skeleton of each person in each image, in the camera's axes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Members, Npz
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.readers.arrays import check_rotations
from rnd_runtime.motion.readers.tracks import VIDEO_FPS, without_gaps
from rnd_runtime.motion.readers.tree import Floats, MocapTree
from rnd_runtime.motion.readers.video_fits import trailing_number

from .rigs import MHR127, WorldTree, rigidity, world_tree

NEEDED = ("pred_cam_t", "pred_joint_coords", "pred_global_rots")
_WRAPPERS = ("frames", "outputs", "results", "people", "persons")
_SUFFIXES = (".npz", ".npy", ".pkl", ".pt", ".json")
_FLIP = np.diag([1.0, -1.0, -1.0])  # camera's right, down, forward ↔ right, up, backward
_CONTRADICTION = 0.25  # of a bone's length
_NOTES = (
    f"no frame rate in the file: {VIDEO_FPS:g} frames per second assumed, as most videos have",
    "no world coordinates in the file: the camera is taken to stand level; --in-place keeps the root",
    "MHR's shape and scale are ignored: the avatar keeps its own",
)
_WHO = "several people in an image: the one nearest to the camera is followed"

Person = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """One person, with OpenCV's camera axes turned right, up, backward.

    Attributes:
        frames: [F] ascending numbers of images.
        positions: [F, 127, 3] m, world positions of MHR's joints.
        rotations: [F, 127, 3, 3] of the joints in the world.
        focal: px, the camera's focal length where stated.
        notes: omissions.
    """

    frames: NDArray[np.int64]
    positions: Floats
    rotations: Floats
    focal: float | None
    notes: tuple[str, ...]

    def as_seen(self) -> WorldTree:
        """The skeleton of the pelvis and all below it at ``frames``, the camera at the origin."""
        parents = [parent - 1 for parent in MHR127.parents[1:]]
        return world_tree(MHR127.names[1:], parents, self.positions[:, 1:], self.rotations[:, 1:], VIDEO_FPS)

    def tree(self, path: str | Path) -> MocapTree:
        """The motion of the pelvis and all below it, with gaps interpolated, beginning above the origin."""
        tree = self.as_seen()
        poses = matrix_to_axis_angle(tree.rotations).reshape(len(self.frames), -1)
        poses, world, filled = without_gaps(self.frames, poses, tree.world.reshape(len(self.frames), -1), path)
        rotations = axis_angle_to_matrix(poses.reshape(len(poses), -1, 3))
        world = world.reshape(len(poses), -1, 3)
        world = world - world[0, 0] * [1, 0, 1]
        notes = (*_NOTES, *self.notes, *filled)
        return replace(tree, rotations=rotations, root_positions=world[:, 0], notes=notes, world=world)


def is_sam3d(content: Any) -> bool:
    """Whether ``content`` is SAM 3D Body's: people per image, or the same as arrays over images."""
    moments = _moments(content)
    return any(people for _, people in moments)


def read_sam3d(content: Any, path: str | Path) -> BodyTrack:
    """The person nearest to the camera, followed from image to image.

    Raises:
        InputError: no person, other shapes, or rotations that contradict the positions.
    """
    moments = [(frame, people) for frame, people in _moments(content) if people]
    last: Floats | None = None
    chosen = []
    for frame, people in moments:
        places = np.stack([np.asarray(person["pred_cam_t"], np.float64).reshape(3) for person in people])
        nearest = places[:, 2] if last is None else np.linalg.norm(places - last, axis=1)
        index = int(nearest.argmin())
        last = places[index]
        chosen.append((frame, people[index]))
    frames = np.array([frame for frame, _ in chosen], np.int64)
    persons = Members({name: [np.asarray(p[name], np.float64) for _, p in chosen] for name in NEEDED}, path)
    joints, rotations = persons.numbers("pred_joint_coords"), persons.numbers("pred_global_rots")
    count = len(MHR127.names)
    if joints.shape[1:] != (count, 3) or rotations.shape[1:] != (count, 3, 3):
        got = f"{'×'.join(map(str, joints.shape[1:]))} and {'×'.join(map(str, rotations.shape[1:]))}"
        expected = f"{count}×3 joints and {count}×3×3 rotations of MHR"
        raise InputError("SAM 3D Body's results", expected=expected, got=got, file=path)
    positions = (joints + persons.numbers("pred_cam_t").reshape(-1, 1, 3)) @ _FLIP
    rotations = _in_the_same_axes(positions, check_rotations(rotations, "pred_global_rots", path), path)
    notes = (_WHO,) if any(len(people) > 1 for _, people in moments) else ()
    focal = [float(np.reshape(p["focal_length"], -1)[0]) for _, p in chosen if p.get("focal_length") is not None]
    return BodyTrack(frames, positions, rotations, float(np.median(focal)) if focal else None, notes)


def read_folder(folder: Path) -> list[Any]:
    """Contents of a folder with a file per image, as (number, content)."""
    files = sam3d_files(folder)
    return [(trailing_number(file.stem, k), _content(file)) for k, file in enumerate(files)]


def sam3d_files(folder: Path) -> list[Path]:
    """The files of ``folder`` that may be of images, by name."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)


def is_sam3d_folder(folder: Path) -> bool:
    """Whether the first file of ``folder`` is SAM 3D Body's."""
    files = sam3d_files(folder)
    try:
        return bool(files) and is_sam3d(_content(files[0]))
    except InputError:
        return False


def _content(file: Path) -> Any:
    if file.suffix.lower() == ".json":
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError("cannot be read", expected="JSON", got=str(error), file=file) from error
    if file.suffix.lower() == ".npz":
        with Npz(file, what="SAM 3D Body's results") as archive:
            return {name: archive.numbers(name) for name in (*NEEDED, "focal_length") if name in archive.names}
    from rnd_runtime.motion.readers.unpickle import read_pickle

    return read_pickle(file, what="SAM 3D Body's results")


def _moments(content: Any) -> list[tuple[int, list[Person]]]:
    """(number, people) of each image in any of the forms in which the results are kept; empty for other content."""
    if isinstance(content, Mapping):
        if set(NEEDED) <= content.keys():
            if np.ndim(content["pred_joint_coords"]) < 3:
                return [(0, [content])]
            return [(k, [_row(content, k)]) for k in range(len(content["pred_joint_coords"]))]
        for name in _WRAPPERS:
            if name in content and (found := _moments(content[name])):
                return found
        numbered = [
            (trailing_number(str(key).rsplit(".", 1)[0], k), value) for k, (key, value) in enumerate(content.items())
        ]
        return _ascending([(number, _people(value)) for number, value in numbered])
    if isinstance(content, Sequence) and not isinstance(content, str | bytes):
        pairs = [pair for pair in content if isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], int)]
        if pairs and len(pairs) == len(content):
            return _ascending([(number, _people(value)) for number, value in pairs])
        return [(k, _people(value)) for k, value in enumerate(content)]
    return []


def _ascending(moments: list[tuple[int, list[Person]]]) -> list[tuple[int, list[Person]]]:
    return sorted(moments, key=lambda moment: moment[0])


def _people(value: Any) -> list[Person]:
    """People of one image."""
    if isinstance(value, Mapping):
        if set(NEEDED) <= value.keys():
            joints = value["pred_joint_coords"]
            return [value] if np.ndim(joints) < 3 else [_row(value, k) for k in range(len(joints))]
        inner = next((value[name] for name in _WRAPPERS if name in value), None)
        if inner is None:
            inner = list(value.values())
        return [] if isinstance(inner, Mapping) and not inner else _people(inner) if isinstance(inner, Sequence) else []
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [person for person in value if isinstance(person, Mapping) and set(NEEDED) <= person.keys()]
    return []


def _row(arrays: Person, k: int) -> Person:
    """Entry ``k`` of arrays over images or people."""
    row = {name: np.asarray(arrays[name])[k] for name in NEEDED}
    if arrays.get("focal_length") is not None:
        focal = np.reshape(arrays["focal_length"], -1)
        row["focal_length"] = focal[min(k, len(focal) - 1)]
    return row


def _in_the_same_axes(positions: Floats, rotations: Floats, path: str | Path) -> Floats:
    """``rotations`` in the axes of ``positions``: SAM 3D Body flips its positions alone, other programs both."""
    parents = MHR127.parents
    options = (rotations, _FLIP @ rotations)
    if len(positions) == 1:  # no time to compare with: as SAM 3D Body writes them
        return rotations
    off = [rigidity(parents, positions, option) for option in options]
    best = int(np.argmin(off))
    if off[best] > _CONTRADICTION:
        got = f"bones that leave them by {off[best]:.0%} of their length"
        raise InputError("pred_global_rots", expected="rotations of pred_joint_coords", got=got, file=path)
    return options[best]
