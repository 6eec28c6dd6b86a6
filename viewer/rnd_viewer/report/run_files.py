"""The JSON files of a training's folder, checked as far as a report reads them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import are_rows, existing_file

Row = dict[str, Any]
MAX_STEPS = 1e12
LARGEST_NUMBER = 1e300  # of integers, which JSON does not bound


def read_config(run: Path) -> Row:
    """``config.json``: the options of the training in ``run``.

    Raises:
        InputError: it is missing or damaged; as of all functions here.
    """
    file = existing_file(run / "config.json", what="config.json of rnd-train")
    config = _json(file)
    if not isinstance(config, dict):
        raise InputError("config.json of rnd-train", expected="an object", got="another", file=file)
    return config


def read_scores(run: Path, words: Sequence[str], numbers: Iterable[str]) -> list[Row]:
    """``eval.json``: rows of rnd-eval, none where there is no such file.

    ``words`` and ``numbers`` name a row's fields; each may be missing or null.
    """
    file = run / "eval.json"
    if not file.is_file():
        return []
    rows = read_rows(file, "rows of rnd-eval", "split")
    _check_numbers(rows, numbers, file)
    for row in rows:
        for name in words:
            if not isinstance(row.get(name), str | None):
                raise InputError(name, expected="a text", got=json.dumps(row[name]), file=file)
    return rows


def read_losses(run: Path) -> list[Row]:
    """``metrics.jsonl``: one row of numbers for each step, none where there is no such file.

    An incomplete last line is left out.
    """
    file = run / "metrics.jsonl"
    if not file.is_file():
        return []
    try:
        *whole, last = file.read_text(encoding="utf-8").split("\n")
        rows = [json.loads(line) for line in whole if line.strip()]
    except (ValueError, RecursionError) as error:
        raise InputError("not JSON lines", got=error, file=file) from error
    with suppress(ValueError, RecursionError):
        rows.append(json.loads(last))
    _check_rows(rows, file, "a step in every line", "step")
    _check_numbers(rows, {name for row in rows for name in row}, file)
    if any(row["step"] is None for row in rows):
        raise InputError("step", expected="a number", got="null", file=file)
    for row in rows:
        if not 0 <= row["step"] <= MAX_STEPS:  # true for NaN
            got = json.dumps(row["step"])[:80]
            raise InputError("step", expected=f"a number, 0 to {MAX_STEPS:g}", got=got, file=file)
    return rows


def read_rows(file: Path, what: str, *names: str) -> list[Row]:
    """A list of objects that have all of ``names``; ``what`` names such a file."""
    rows = _json(file)
    _check_rows(rows, file, what, *names)
    return rows


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not UTF-8 is a ValueError too
        raise InputError("not JSON", got=error, file=file) from error


def _check_rows(rows: Any, file: Path, what: str, *names: str) -> None:
    if not are_rows(rows, names):
        raise InputError(file.name, expected=what, got="something else", file=file)


def _check_numbers(rows: Iterable[Row], names: Iterable[str], file: Path) -> None:
    wanted = set(names)
    for row in rows:
        for name in row.keys() & wanted:
            value = row[name]
            good = isinstance(value, int | float | None)  # a bool is an int here: "skipped"
            if not good or (isinstance(value, int) and abs(value) > LARGEST_NUMBER):
                raise InputError(name, expected="a number", got=json.dumps(value)[:80], file=file)
