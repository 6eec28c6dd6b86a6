"""Joint names of other programs: the tables of ``joint_names.toml`` and the user's."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

JointTable = dict[str, tuple[str, ...]]
"""Names of each of the avatar's joints in other programs, preferred ones first."""

_SIDES = ("left", "right")
_MIN_JOINTS = 8  # nearly a root and four limbs of two joints
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
    table: JointTable = {}
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
) -> dict[str, int]:
    """Index in ``theirs`` of each joint of ``ours`` that is found there.

    Uses the one naming of ``joint_names.toml`` that matches most joints: "LeftShoulder" may be a collar bone or a
    shoulder. Entries of ``extra``, read from ``file``, take precedence.

    Raises:
        InputError: ``extra`` names unknown joints, or no naming matches enough.
    """
    indices = {_plain(name): index for index, name in reversed(list(enumerate(theirs)))}

    def found(table: Mapping[str, tuple[str, ...]]) -> dict[str, int]:
        plain = {joint: map(_plain, names) for joint, names in table.items() if joint in ours}
        hits = {
            joint: next((indices[name] for name in names if name in indices), None) for joint, names in plain.items()
        }
        return {joint: index for joint, index in hits.items() if index is not None}

    extra = extra or {}
    if unknown := [joint for joint in extra if joint not in ours]:
        expected = f"joints of the avatar ({', '.join(ours)})"
        raise InputError("joint map", expected=expected, got=", ".join(unknown), file=file)
    given = found(extra)
    if len(given) < len(extra):
        absent = ", ".join(" or ".join(names) for joint, names in extra.items() if joint not in given)
        raise InputError("joint map", expected=f"joints of the motion ({', '.join(theirs)})", got=absent, file=file)
    best = max((found(table) for table in _known_tables()), key=len)
    matched = {joint: index for joint, index in best.items() if index not in given.values()} | given
    if len(matched) < min(_MIN_JOINTS, len(ours)):
        raise InputError(
            "joints of the motion", expected=f"at least {_MIN_JOINTS} known names", got=", ".join(theirs), hint=_HINT
        )
    return matched


def _known_tables() -> list[JointTable]:
    text = resources.files(__package__ or "rnd_runtime").joinpath("joint_names.toml").read_text(encoding="utf-8")
    return [_table(section) for section in tomllib.loads(text).values()]


def _table(section: Mapping[str, Any]) -> JointTable:
    """One naming with its sides expanded."""
    sides = section.get("sides", list(_SIDES))
    if not (isinstance(sides, list) and len(sides) == 2 and all(isinstance(side, str) for side in sides)):
        raise InputError("sides", expected='two names such as ["Left", "Right"]', got=sides)
    table: JointTable = {}
    for joint, value in section.items():
        if joint == "sides":
            continue
        names = value if isinstance(value, list) else [value]
        if not names or not all(isinstance(name, str) for name in names):
            raise InputError(joint, expected="a joint's name or a list of names", got=value)
        for side, theirs in zip(_SIDES, sides) if "*" in joint else (("", ""),):
            table[joint.replace("*", side)] = tuple(name.replace("*", theirs) for name in names)
    return table


def _plain(name: str) -> str:
    """``name`` without namespace, separators and capitals."""
    return name.rsplit(":", 1)[-1].translate(str.maketrans("", "", "_-. ")).lower()
