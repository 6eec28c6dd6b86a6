"""Scene files: who stands where, and when they begin to move.

::

    [[person]]
    avatar = "me.onnx"       # files are relative to the scene's
    motion = "walk.npz"
    position = [1.5, -2]     # of the motion's origin on the ground, x and z in metres; default [0, 0]
    heading = 90             # degrees to the left: 90 turns +Z to +X; default 0
    start = 0.5              # second of the scene at which the motion begins; default 0
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

MAX_PEOPLE = 1000
MAX_METRES, MAX_DEGREES, MAX_SECONDS = 1e4, 1e6, 1e6
_HEADER = re.compile(r"\s*\[\[\s*[\"']?person[\"']?\s*\]\]")


@dataclass(frozen=True)
class PersonRecord:
    """One ``[[person]]``: files, ``position`` (x, z) in m, ``heading`` in degrees, ``start`` in s."""

    avatar: Path
    motion: Path
    position: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0
    start: float = 0.0


def is_scene(file: Path) -> bool:
    """Whether ``file`` is named as a scene file is."""
    return file.suffix.lower() == ".toml"


def read_scene(path: Path) -> list[PersonRecord]:
    """Read a scene file.

    Raises:
        InputError: naming key and line.
    """
    file = existing_file(path, what="scene file")
    try:
        text = file.read_bytes().decode("utf-8-sig")
        content = tomllib.loads(text)
    except (UnicodeDecodeError, RecursionError, tomllib.TOMLDecodeError) as error:
        raise InputError("scene file", expected="TOML", got=str(error), file=file) from error
    for key in content.keys() - {"person"}:
        raise InputError(_at(text, key), expected="[[person]] tables alone", file=file)
    tables = content.get("person")
    if not isinstance(tables, list) or not 1 <= len(tables) <= MAX_PEOPLE:
        raise InputError("scene", expected=f"1 to {MAX_PEOPLE} [[person]] tables", got=tables or "none", file=file)
    try:
        return [_Table(text, number, table, file.parent).record() for number, table in enumerate(tables)]
    except InputError as error:
        raise error.at(file=file) from error


@dataclass(frozen=True)
class _Table:
    """Table ``number`` of a scene file's ``text``; its files are in ``folder``."""

    text: str
    number: int
    values: dict[str, Any]
    folder: Path

    def record(self) -> PersonRecord:
        if not isinstance(self.values, dict):
            raise InputError("person", expected="[[person]] tables", got=self.values)
        for key in self.values.keys() - PersonRecord.__dataclass_fields__.keys():
            expected = ", ".join(PersonRecord.__dataclass_fields__)
            raise InputError(self._at(key), expected=f"one of {expected}", got="an unknown key")
        x, z = self._position()
        return PersonRecord(
            avatar=self._file("avatar"),
            motion=self._file("motion"),
            position=(x, z),
            heading=self._number("heading", MAX_DEGREES),
            start=self._number("start", MAX_SECONDS),
        )

    def _at(self, key: str) -> str:
        return _at(self.text, key, self.number)

    def _file(self, key: str) -> Path:
        value = self.values.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise InputError(self._at(key), expected="the name of a file", got="nothing" if value is None else value)
        return self.folder / value

    def _number(self, key: str, most: float) -> float:
        value = self.values.get(key, 0.0)
        if not _is_number(value, most):
            raise InputError(self._at(key), expected=f"a number of at most {most:g}", got=value)
        return float(value)

    def _position(self) -> tuple[float, float]:
        value = self.values.get("position", [0.0, 0.0])
        if not (isinstance(value, list) and len(value) == 2 and all(_is_number(each, MAX_METRES) for each in value)):
            raise InputError(self._at("position"), expected=f"[x, z] of at most {MAX_METRES:g} metres", got=value)
        return float(value[0]), float(value[1])


def _is_number(value: object, most: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= most


def _at(text: str, key: str, number: int | None = None) -> str:
    """``line 7: key`` of person ``number``, or of no table; the line of the table's header where the key is missing."""
    name = re.compile(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[.=]|\s*\[+\s*[\"']?{re.escape(key)}\b")
    header, table = 0, -1
    for count, line in enumerate(text.splitlines(), start=1):
        if _HEADER.match(line):
            table += 1
            header = count if table == number else header
        elif (number is None or table == number) and name.match(line):
            return f"line {count}: {key}"
    return f"line {header}: {key}" if header else key
