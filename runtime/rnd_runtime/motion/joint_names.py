"""Joint names of other programs: the tables of ``joint_names.toml`` and the user's."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

from .limbs import Bones
from .spelling import keys, plain, sided

JointTable = Mapping[str, tuple[str, ...]]
"""Names of each of the avatar's joints in other programs, preferred ones first."""

_SIDES = ("left", "right")
_MIN_JOINTS = 8  # nearly a root and four limbs of two joints
_CONTRADICTS = 2  # joints that must speak for a naming against each bone that contradicts it
_HINT = "name them in a file given as --joint-map"


def load_joint_map(path: str | Path) -> JointTable:
    """Read a user's table, .toml or .json, in the form of ``joint_names.toml``; its sections are merged.

    Raises:
        InputError: the file is neither, or a line is not a name or a list of names.
    """
    path = existing_file(path, what="joint map")
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("joint map", expected="TOML or JSON", got=str(error), file=path) from error
    if not isinstance(content, dict):
        raise InputError("joint map", expected="our joints and theirs", got=type(content).__name__, file=path)
    flat = {name: value for name, value in content.items() if not isinstance(value, dict)}
    table: dict[str, tuple[str, ...]] = {}
    for section in (flat, *(value for value in content.values() if isinstance(value, dict))):
        try:
            table.update(_table(section))
        except InputError as error:
            raise error.at(file=path) from error
    if not table:
        raise InputError("joint map", expected="at least one joint", got="none", file=path)
    return table


def match_joints(
    theirs: Sequence[str],
    ours: Sequence[str],
    extra: Mapping[str, tuple[str, ...]] | None = None,
    file: str | Path | None = None,
    bones: Bones | None = None,
) -> dict[str, int]:
    """Index in ``theirs`` of each joint of ``ours`` that is found there.

    Uses the naming of ``joint_names.toml`` that matches most joints and contradicts ``bones`` least: "LeftShoulder"
    may be a collar bone or a shoulder, "LeftLeg" a thigh or a shin. Joints that it lacks come from other namings,
    where ``bones`` agree, or from their place between others. Entries of ``extra``, read from ``file``, take
    precedence.

    Raises:
        InputError: ``extra`` names unknown joints, or no naming matches enough.
    """
    indices = keys(theirs)
    extra = extra or {}
    if unknown := [joint for joint in extra if joint not in ours]:
        expected = f"joints of the avatar ({', '.join(ours)})"
        raise InputError("joint map", expected=expected, got=", ".join(unknown), file=file)
    given = _found(extra, indices[:1], ours)
    if len(given) < len(extra):
        absent = ", ".join(" or ".join(names) for joint, names in extra.items() if joint not in given)
        raise InputError("joint map", expected=f"joints of the motion ({', '.join(theirs)})", got=absent, file=file)
    namings = [_found(table, indices, ours) for table in _known_tables()]
    if bones is not None:
        namings.sort(key=lambda found: _CONTRADICTS * bones.contradictions(found) - len(found))
    best = max(namings, key=len) if bones is None else namings[0]
    matched = {joint: index for joint, index in best.items() if index not in given.values()} | given
    if bones is not None:
        for naming in namings[1:]:
            for joint, index in naming.items():
                more = matched | {joint: index}
                new = joint not in matched and index not in matched.values()
                if new and bones.contradictions(more) <= bones.contradictions(matched):
                    matched = more
        between = bones.between(matched)
        matched |= {joint: index for joint, index in between.items() if joint in ours and joint not in given}
        spine = {joint: index for joint, index in bones.spine(matched).items() if joint in ours}
        if spine and not given.keys() & spine.keys():
            matched = {joint: index for joint, index in matched.items() if not joint.startswith("spine")} | spine
    if len(matched) < min(_MIN_JOINTS, len(ours)):
        raise InputError(
            "joints of the motion", expected=f"at least {_MIN_JOINTS} known names", got=", ".join(theirs), hint=_HINT
        )
    return matched


def joints_of_map(path: str | Path, theirs: Sequence[str], ours: Sequence[str]) -> dict[str, int]:
    """Index in ``theirs`` of each joint of ``ours`` that the user's table ``path`` names, nothing else.

    Raises:
        InputError: it is no table, or names joints that either lacks.
    """
    table = load_joint_map(path)
    indices = {plain(name): index for index, name in reversed(list(enumerate(theirs)))}
    found = {}
    for joint, names in table.items():
        index = next((indices[plain(name)] for name in names if plain(name) in indices), None)
        if index is None or joint not in ours:
            got = joint if joint not in ours else " or ".join(names)
            raise InputError("joint map", expected="joints of the avatar and of the motion", got=got, file=path)
        found[joint] = index
    return found


@cache
def _known_tables() -> list[JointTable]:
    text = resources.files(__package__ or "rnd_runtime").joinpath("joint_names.toml").read_text(encoding="utf-8")
    return [_table(section) for section in tomllib.loads(text).values()]


def _found(table: JointTable, indices: Sequence[Mapping[str, int]], ours: Sequence[str]) -> dict[str, int]:
    """Index of each joint of ``table`` by its first name that ``indices`` have, each index once."""
    found: dict[str, int] = {}
    for joint, names in table.items():
        if joint not in ours:
            continue
        spelled = [[plain(name) for name in names]] * 2 + [[sided(name) for name in names]]
        hits = [by[key] for by, keys_ in zip(indices, spelled) for key in keys_ if key in by]
        if new := [hit for hit in hits if hit not in found.values()]:
            found[joint] = new[0]
    return found


def _table(section: Mapping[str, Any]) -> JointTable:
    """One naming with its sides expanded."""
    sides = section.get("sides", list(_SIDES))
    if not (isinstance(sides, list) and len(sides) == 2 and all(isinstance(side, str) for side in sides)):
        raise InputError("sides", expected='two names such as ["Left", "Right"]', got=sides)
    table: dict[str, tuple[str, ...]] = {}
    for joint, value in section.items():
        if joint == "sides":
            continue
        names = value if isinstance(value, list) else [value]
        if not names or not all(isinstance(name, str) for name in names):
            raise InputError(joint, expected="a joint's name or a list of names", got=value)
        for side, theirs in zip(_SIDES, sides) if "*" in joint else (("", ""),):
            table[joint.replace("*", side)] = tuple(name.replace("*", theirs) for name in names)
    return table
