"""The table of measured rows: JSON, Markdown and images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rnd_bench.scenes.psnr import Bytes
from rnd_runtime.core.files import atomic_path, earlier_rows, write_json
from rnd_runtime.core.images import write_image

from .figures import Figure, amount

MARKS = {"pass": "✓", "fail": "✗"}


def rows_of(file: Path) -> list[dict[str, Any]]:
    """Rows of an earlier table; another file is refused."""
    return earlier_rows(file, what="rows of rnd-bench stability", names=("id", "what"))


def store(
    file: Path, about: dict[str, Any], figures: Sequence[Figure], images: tuple[Bytes, Bytes] | None = None
) -> None:
    """Replace a row's figures in ``file`` and in the .md beside it, and its images; ``about`` identifies the row."""
    rows = [row for row in rows_of(file) if row["id"] != about["id"]]
    for figure in figures:
        row = {name: about[name] for name in ("id", "failure")}
        row |= {name: getattr(figure, name) for name in ("what", "measured", "unit", "line")}
        row |= {"verdict": verdict(figure), "baseline": figure.baseline, "baseline_name": figure.baseline_name}
        rows.append(row | about)
    rows.sort(key=lambda row: ("PGLRHTFSKD".find(row["id"][0]), int(row["id"][1:] or 0)))
    write_json(file, rows)
    with atomic_path(file.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(rows), encoding="utf-8")
    if images is not None:
        write_image(file.with_suffix("") / f"{about['id']}.png", np.concatenate(images, axis=1))


def verdict(figure: Figure) -> str:
    if figure.measured is None:
        return "not measured"
    if not figure.passes:
        return "fail"
    return "pass" if figure.line else "reported"


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table; null in JSON is NaN where the verdict is not "not measured"."""
    lines = ["| id | failure | measured | | line | | the plain method |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        baseline, unit, measured = "", row["unit"], row["measured"]
        if measured is None and row["verdict"] != "not measured":
            measured = math.nan
        if row["baseline_name"]:
            plain = math.nan if row["baseline"] is None else row["baseline"]
            baseline = f"{row['baseline_name']}: {amount(plain, unit)}"
        mark = MARKS.get(row["verdict"], "").replace("✗", "**✗**")
        what = row["what"].replace("|", "\\|").replace("\n", " ")
        cells = (row["id"], row["failure"], what, amount(measured, unit), row["line"], mark, baseline)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def line_of(name: str, figure: Figure) -> str:
    baseline = ""
    if figure.baseline is not None:
        baseline = f"  ({figure.baseline_name}: {amount(figure.baseline, '')})"
    mark = MARKS.get(verdict(figure), " ")
    return f"{mark} {name:4} {figure.what}: {amount(figure.measured, figure.unit)} {figure.line}{baseline}"
