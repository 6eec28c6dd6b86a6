"""Body fits of one person in a video: EasyMocap (a JSON file per frame) and PHALP (a pickle)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import matrix_to_axis_angle

Floats = NDArray[np.float64]

PHALP_FOCAL = 5000 / 256
"""of the image's longer side: EXTRA.FOCAL_LENGTH / render.res"""

_MAX_NUMBER = 1e15  # of a frame: whole as a float, too
_HAND_COEFFICIENTS = {78: "SMPL", 87: "SMPL-X"}
"""columns of EasyMocap's SMPL-H and SMPL-X poses: 22 joints, then coefficients of hands and face"""


@dataclass(frozen=True, eq=False)
class VideoFits:
    """Fits of one person.

    Attributes:
        person: id; ``others`` are in the file too.
        frames: [F] ascending image numbers.
        axis_angles: [F, 3J] rad, the root first.
        translations: [F, 3] m.
        betas: [F, B].
        turns: [F, 3] rad, EasyMocap's Rh: x = R(Rh) X + translation, about the origin; None for rotations about the
            root's rest position.
        family: "SMPL" or "SMPL-X".
    """

    person: int
    others: tuple[int, ...]
    frames: NDArray[np.int64]
    axis_angles: Floats
    translations: Floats
    betas: Floats
    turns: Floats | None = None
    family: str = "SMPL"


def read_easymocap_folder(folder: Path, person: int | None = None) -> VideoFits:
    """Read ``folder`` of files such as ``000012.json``: a list of {``id``, ``Rh``, ``Th``, ``poses``, ``shapes``}.

    Args:
        person: id; by default the one in most frames.
    """
    files = easymocap_files(folder)
    if not files:
        raise InputError("EasyMocap fits", expected=".json files", got="none", file=folder)
    moments: dict[int, dict[int, Any]] = {}
    for index, file in enumerate(files):
        moments[trailing_number(file.stem, index)] = _people(file)
    chosen, others = one_of([key for people in moments.values() for key in people], person, folder)
    kept = {frame: people[chosen] for frame, people in sorted(moments.items()) if chosen in people}
    try:
        poses, turns, translations, betas = (
            np.stack([np.asarray(entry[key], np.float64).reshape(-1) for entry in kept.values()])
            for key in ("poses", "Rh", "Th", "shapes")
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("EasyMocap fits", expected="Rh, Th, poses, shapes", got=repr(error), file=folder) from error
    if turns.shape[1] != 3 or translations.shape[1] != 3:
        raise InputError(
            "Rh and Th", expected="3 numbers", got=f"{turns.shape[1]}, {translations.shape[1]}", file=folder
        )
    family = _HAND_COEFFICIENTS.get(poses.shape[1], "SMPL")
    poses = with_root(poses[:, :66] if poses.shape[1] in _HAND_COEFFICIENTS else poses)
    frames = np.array(list(kept), np.int64)
    return VideoFits(chosen, others, frames, poses, translations, betas, turns, family)


def easymocap_files(folder: Path) -> list[Path]:
    """The files of ``folder`` that ``read_easymocap_folder`` reads."""
    return sorted(folder.glob("*.json"))


def is_phalp(content: Mapping[Any, Any]) -> bool:
    """Whether ``content`` is PHALP's or 4D-Humans': image → {``tid``, ``smpl``, ``camera``, …}."""
    moments = _moments(content)
    return bool(moments) and all({"smpl", "camera", "tid"} <= moment.keys() for moment in moments)


def read_phalp(content: Mapping[Any, Any], path: Path, person: int | None = None) -> VideoFits:
    """Read PHALP's content (``is_phalp``): rotation matrices, and positions at the focal length ``PHALP_FOCAL``.

    Images without a new detection of the track (``tracked_time`` > 0) are left out.

    Args:
        person: a track number; by default the one in most images.
    """
    moments = sorted(_moments(content), key=lambda moment: int(moment.get("time", 0)))
    tracks = [_phalp_tracks(moment) for moment in moments]
    chosen, others = one_of([track for seen in tracks for track in seen], person, path)
    frames, angles, translations, betas = [], [], [], []
    for number, (moment, seen) in enumerate(zip(moments, tracks)):
        if chosen not in seen:
            continue
        index = seen[chosen]
        smpl = moment["smpl"][index]
        parts = [np.asarray(smpl[key], np.float64).reshape(-1, 3, 3) for key in ("global_orient", "body_pose")]
        frames.append(int(moment.get("time", number)))
        angles.append(matrix_to_axis_angle(np.concatenate(parts)).reshape(-1))
        translations.append(np.asarray(moment["camera"][index], np.float64).reshape(3))
        betas.append(np.asarray(smpl["betas"], np.float64).reshape(-1))
    return VideoFits(
        chosen, others, np.array(frames, np.int64), np.stack(angles), np.stack(translations), np.stack(betas)
    )


def _moments(content: Mapping[Any, Any]) -> list[Mapping[str, Any]]:
    """The entries of images; some versions store others too."""
    return [value for value in content.values() if isinstance(value, Mapping)]


def _phalp_tracks(moment: Mapping[str, Any]) -> dict[int, int]:
    """Index in ``moment`` of every track detected there."""
    tracks = moment["tid"][: len(moment["smpl"])]
    ages = moment.get("tracked_time", [0] * len(tracks))
    return {int(track): index for index, (track, age) in enumerate(zip(tracks, ages)) if age == 0}


def one_of(seen: Sequence[int], person: int | None, path: Path) -> tuple[int, tuple[int, ...]]:
    """The chosen id, ``person`` or the most frequent in ``seen`` (one entry per detection), and the others."""
    numbers = tuple(dict.fromkeys(seen))
    if not numbers:
        raise InputError("people", expected="at least one", got="none", file=path)
    if person is not None and person not in numbers:
        raise InputError("--person", expected=" or ".join(map(str, numbers)), got=person)
    chosen = max(numbers, key=list(seen).count) if person is None else person
    return chosen, tuple(number for number in numbers if number != chosen)


def in_order(frames: ArrayLike, *values: ArrayLike) -> tuple[NDArray[np.int64], list[Floats]]:
    """A track's ascending frame numbers [F] and its ``values`` [F, …]; the first of repeated numbers.

    Raises:
        InputError: their lengths differ, or frames have no numbers.
    """
    numbers = _frame_numbers(frames)
    arrays = [np.asarray(value, np.float64) for value in values]
    for array in arrays:
        if array.shape[:1] != numbers.shape:
            got = f"{len(array)} and {numbers.size} frame_ids"
            raise InputError("poses of a track", expected="one a frame", got=got)
    ascending, first = np.unique(numbers, return_index=True)
    return ascending, [array[first] for array in arrays]


def _frame_numbers(frames: ArrayLike) -> NDArray[np.int64]:
    """``frames`` [F] as whole numbers."""
    try:
        numbers = np.asarray(frames, np.float64).reshape(-1)
        if (np.abs(numbers) < _MAX_NUMBER).all():  # nor NaN
            return np.asarray(frames).reshape(-1).astype(np.int64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    got = f"{np.abs(numbers).max():g}" if numbers.size else "others"
    raise InputError("frame numbers", expected=f"whole numbers below {_MAX_NUMBER:g}", got=got)


def order_notes(frames: ArrayLike) -> tuple[str, ...]:
    """A note where a track's frame numbers are not ``in_order``."""
    back = np.flatnonzero(np.diff(_frame_numbers(frames)) <= 0)
    return ("frame numbers are out of order: sorted; of repeated ones the first counts",) if len(back) else ()


def with_root(poses: Floats) -> Floats:
    """Poses [F, 3J] with a zero root prepended where it is missing (63 and 69 columns)."""
    if poses.shape[1] in (63, 69):
        return np.concatenate([np.zeros((len(poses), 3)), poses], 1)
    return poses


def trailing_number(stem: str, otherwise: int) -> int:
    """The number at the end of ``stem``, or ``otherwise``."""
    digits = stem[len(stem.rstrip("0123456789")) :]
    return int(digits) if digits else otherwise


def _people(file: Path) -> dict[int, Any]:
    """People in one file, by id."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError("cannot be read", expected="JSON", got=str(error), file=file) from error
    people = content.get("annots", []) if isinstance(content, dict) else content
    if not isinstance(people, list) or not all(isinstance(entry, dict) for entry in people):
        raise InputError("EasyMocap fits", expected="a list of people", got=type(content).__name__, file=file)
    try:
        return {int(entry.get("id", 0)): entry for entry in people}
    except (TypeError, ValueError) as error:
        raise InputError("id", expected="a whole number", got=str(error), file=file) from error
