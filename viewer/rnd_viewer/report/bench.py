"""The parts of a report from ``rnd-bench``: the speed–accuracy chart and the table of stability."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of

from .html_parts import data_uri, figure, number, table
from .run_files import read_rows

TITLE = "Benchmarks: speed, accuracy, stability"
CHARTS = ("crossed.svg", "grid.svg")  # the first that exists
STABILITY = "stability.json"
HEAD = ("id", "failure", "what was measured", "measured", "limit", "verdict", "baseline")
WORDS = (0, 1, 2, 5, 6)
MARKS = {"pass": "✓", "fail": "✗"}


def bench_section(folder: Path, run: Path) -> str:
    """Chart and table of ``folder``, each with its file and the avatar it was measured on."""
    parts = []
    if chart := next((folder / name for name in CHARTS if (folder / name).is_file()), None):
        parts.append(_chart(chart, run))
    if (stability := folder / STABILITY).is_file():
        parts.append(_stability(stability, run))
    if not parts:
        raise InputError("--bench", expected=f"{' or '.join((*CHARTS, STABILITY))}", got="none of them", file=folder)
    return "".join(parts)


def _chart(file: Path, run: Path) -> str:
    data = file.with_suffix(".json")
    rows = read_rows(data, "rows of rnd-bench") if data.is_file() else []
    machines = "; ".join(dict.fromkeys(str(row["machine"]) for row in rows if "machine" in row))
    caption = (
        "Time of a frame against its accuracy; each point is one configuration. "
        f"From {file}{machines and f', measured on {machines}'}. {measured_on(rows, run)}"
    )
    # as an image: inline, its ids could collide with those of the page
    source = data_uri(file.read_bytes(), "image/svg+xml")
    alt = f"points of milliseconds a frame against decibels: {file.stem}"
    return figure(f'<img class="chart" alt="{escape(alt)}" src="{source}">', caption)


def _stability(file: Path, run: Path) -> str:
    rows = read_rows(file, "rows of rnd-bench stability", "id", "what")
    caption = f"From {file}. {measured_on(rows, run)} ✓ within its limit, ✗ not; without a limit it is only reported."
    cells = [
        (
            row["id"],
            row.get("failure"),
            row["what"],
            _amount(row),
            row.get("line"),
            MARKS.get(str(row.get("verdict")), row.get("verdict")),
            _plain(row),
        )
        for row in rows
    ]
    return f"<h3>Stability</h3><p>{escape(caption)}</p>" + table(HEAD, cells, WORDS)


def _amount(row: dict[str, Any], name: str = "measured") -> str:
    """A figure with its unit; null in JSON is NaN unless the verdict is "not measured"."""
    if row.get(name) is None:
        return "not measured" if row.get("verdict") == "not measured" else "not a number"
    return f"{number(row[name])}\N{NO-BREAK SPACE}{row.get('unit') or ''}".rstrip()


def _plain(row: dict[str, Any]) -> str:
    name = row.get("baseline_name")
    return f"{name}: {_amount(row, 'baseline')}" if name else ""


def measured_on(rows: Sequence[dict[str, Any]], run: Path) -> str:
    """A sentence on whose avatar ``rows`` were measured, by their checkpoints' hashes."""
    named = [row["checkpoint_sha256"] for row in rows if row.get("checkpoint_sha256")]
    if not named:
        return "The rows do not name the avatar: perhaps not this run's."
    checkpoint = run / "avatar.ckpt"
    own = sha256_of(checkpoint) if checkpoint.is_file() else None
    others = [str(name) for name in named if name != own]
    which = ", ".join(name[:12] for name in dict.fromkeys(others))
    if own is None:
        text = f"Measured on the avatar of checkpoint {which}; this run has no avatar.ckpt to compare."
    elif not others:
        text = "Measured on this run's avatar."
    elif len(others) == len(named):
        text = f"Measured on another avatar, not on this run's (its checkpoint: {which})."
    else:
        ours = len(named) - len(others)
        text = f"{ours} rows measured on this run's avatar, {len(others)} on another (checkpoint {which})."
    silent = len(rows) - len(named)
    return text + (f" {silent} of {len(rows)} rows name no avatar." if silent else "")
