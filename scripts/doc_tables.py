"""Fills the tables of README.md and docs from assets/bench/*.json: python scripts/doc_tables.py

A table stands between ``<!-- table: FILE.json | column, column .1f, … -->`` and ``<!-- end -->``; a column is a key of
the file's rows, with the format of its numbers; FILE.json#KEY has its rows under KEY, A.json+B.json has those of both.
``<!-- chart: FILE.svg -->`` … ``<!-- end -->`` holds an image. Tables and charts without a file stay empty.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
CHART = re.compile(r"(<!-- chart: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
TABLE = re.compile(r"(<!-- table: (\S+) \| (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)

PAGES = {
    page: os.path.relpath(ROOT / "assets" / "bench", page.parent)
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if "<!-- table: " in page.read_text(encoding="utf-8")
}
"""pages with tables, and the folder of their charts as seen from them"""


def filled(text: str, bench: Path, images: str = "../assets/bench") -> str:
    """``text`` with every table and chart as the files in ``bench`` have it; ``images`` is the folder in links."""

    def chart(found: re.Match[str]) -> str:
        image = f"![{Path(found[2]).stem}]({images}/{found[2]})\n"
        return found[1] + (image if (bench / found[2]).is_file() else "") + found[3]

    def table(found: re.Match[str]) -> str:
        files, _, key = found[2].partition("#")
        if not all((bench / name).is_file() for name in files.split("+")):
            return found[1] + found[4]
        rows = []
        for name in files.split("+"):
            whole = json.loads((bench / name).read_text(encoding="utf-8"))
            some = whole[key] if key else whole
            rows += some if isinstance(some, list) else [some]
        columns = [column.strip().partition(" ")[::2] for column in found[3].split(",")]
        lines = [[name for name, _ in columns], ["---"] * len(columns)]
        lines += [[_cell(_value(row, name), form) for name, form in columns] for row in rows]
        return found[1] + "".join(f"| {' | '.join(line)} |\n" for line in lines) + found[4]

    return CHART.sub(chart, TABLE.sub(table, text))


def _value(row: dict[str, Any], name: str) -> object:
    """``name`` of a row; ``split/figure`` looks into a cell."""
    for part in name.split("/"):
        row = row.get(part) if isinstance(row, dict) else None  # type: ignore[assignment]
    return row


def _cell(value: object, form: str) -> str:
    if isinstance(value, list):
        return ", ".join(_cell(one, form) for one in value)
    return "" if value is None else format(value, form)


if __name__ == "__main__":
    for page, images in PAGES.items():
        text = filled(page.read_text(encoding="utf-8"), ROOT / "assets" / "bench", images)
        page.write_text(text, encoding="utf-8")
