"""The speed–accuracy chart: every point, the front that nothing beats, one panel for each stage.

Errors are those to the same avatar in full, so fronts are drawn for each number of Gaussians by itself.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rnd_bench.charts import chart
from rnd_bench.scenes.scenes import USUAL as USUAL_SCENE
from rnd_runtime.core.errors import InputError

from .grid import pareto
from .point import Row

BUDGET_MS, BUDGET_DB = 1000 / 60, 45.0
USUAL = {"encoder": "full", "precision": "f32", "window": None, "raster": "cpu", "threads": 2}
COLOURS = {4_000: "#7fb3d5", 8_000: "#2e86c1", 15_000: "#16a085", 30_000: "#d35400", 60_000: "#8e44ad"}
SEEDED = "seeded"
"""``avatar`` of a row whose networks nobody trained"""
HARD = "X"
"""marks a frame of one of the hardest scenes"""
EDGES = {"ao": "#aaaaaa", "table": "#000000", "table+sun": "#f4d03f", "lights": "#ff4fa3", "brute": "#00c8ff"}
"""of a mark: its shading"""
MARKERS = {"full": "o", "rates": "D", "coarse": "s", "static": "^"}
EDGE = 0.9
"""points wide"""
CEILING_DB = 60.0
"""points above it are drawn on it: a picture that is the reference's has a hundred"""
LEAST_SPAN = 5.0
"""a panel's greatest milliseconds over its least, at least: equal times should look equal, and two of the ticks
1, 2, 5, 10 … have room"""
CROWDED = 500.0
"""that ratio in a panel, from which on only 0.1, 1, 10 … have room"""
COLUMNS, WIDE = 5, 3
"""panels side by side, and how many of them the overview is as wide as"""


def draw_chart(rows: list[Row], files: list[Path]) -> None:
    """Write the chart of ``rows`` to every file, SVG or PNG by its suffix.

    Raises ``InputError`` where nothing was measured.
    """
    rows = [row for row in rows if "psnr_db" in row]
    if not rows:
        raise InputError("chart", expected="at least one measured point", got="none")
    stages = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    below = -(-len(stages) // COLUMNS)
    with chart(files, (13, 5.4 + 2.5 * below)) as figure:
        grid = figure.add_gridspec(1 + below, COLUMNS, height_ratios=[2.2, *[1] * below])
        whole, words = figure.add_subplot(grid[0, :WIDE]), figure.add_subplot(grid[0, WIDE:])
        _overview(whole, words, rows)
        for k, stage in enumerate(stages):
            axes = figure.add_subplot(grid[1 + k // COLUMNS, k % COLUMNS], sharey=whole)
            _stage(axes, rows, stage)
            if k % COLUMNS == 0:
                axes.set_ylabel("dB")
            else:
                axes.tick_params(labelleft=False)


def _overview(axes: Any, words: Any, rows: list[Row]) -> None:
    """All points, and what the usual front is in ``words`` beside them.

    Fronts are drawn for pictures of one size, since smaller ones are always faster, and of the usual scene.
    """
    usual, size = rows[0]["n"], rows[0]["size"]
    easy = [row for row in rows if row["size"] == size and not _hard(row)]
    fronts = {n: list(pareto([row for row in easy if row["n"] == n])) for n in COLOURS}
    for n, along in fronts.items():
        axes.plot(
            [r["ms_median"] for r in along], [_shown_db(r) for r in along], color=COLOURS[n], lw=1, alpha=0.7, zorder=1
        )
    front = fronts.get(usual, [])
    axes.axvline(BUDGET_MS, color="#999", lw=0.8, ls="--")
    axes.axhline(BUDGET_DB, color="#999", lw=0.8, ls="--")
    _points(axes, rows, "ms_median")
    named = [f"front of {usual:,} at {size}²:".replace(",", " ")]
    for number, row in enumerate(front, 1):
        axes.annotate(
            str(number),
            (row["ms_median"], _shown_db(row)),
            xytext=(0, 6),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            weight="bold",
        )
        named.append(f"{number:2}  {_label(row)}: {row['ms_median']:.1f} ms, {row['psnr_db']:.1f} dB")
    words.axis("off")
    words.text(0, 1, "\n".join(named), transform=words.transAxes, fontsize=8, va="top", linespacing=1.5)
    axes.set_xlabel("ms per frame, pose to pixels (median); dashed: 60 frames a second")
    axes.set_ylabel(f"PSNR to the full reference, dB; dashed: 45; cut at {CEILING_DB:g}")
    axes.set_title(f"Speed against accuracy: {len(rows)} points on {rows[0]['machine']}", loc="left")
    handles = [
        axes.scatter([], [], color=colour, label=f"{n:,} Gaussians".replace(",", " "))
        for n, colour in COLOURS.items()
        if any(row["n"] == n for row in rows)
    ]
    handles += [axes.scatter([], [], color="#555", marker=m, label=f"encoder {name}") for name, m in MARKERS.items()]
    handles += [
        axes.scatter([], [], facecolor="#ddd", edgecolor=edge, lw=EDGE, label=f"shade {mode}")
        for mode, edge in EDGES.items()
        if any(_mode(row) == mode for row in rows)
    ]
    handles += [
        axes.scatter([], [], s=_area(side), color="#555", label=f"{side}²")
        for side in sorted({row["size"] for row in rows})
    ]
    if any(_hard(row) for row in rows):
        hard = ", ".join(row["scene"] for row in rows if _hard(row))
        handles.append(axes.scatter([], [], color="#555", marker=HARD, label=hard))
    if any(row["avatar"] == SEEDED for row in rows):
        handles.append(axes.scatter([], [], facecolor="none", edgecolor="#555", label="hollow: an untrained avatar"))
    words.legend(handles=handles, loc="lower left", fontsize=8, frameon=False, borderaxespad=0, ncols=2)


def _stage(axes: Any, rows: list[Row], stage: str) -> None:
    import matplotlib.ticker

    had = [{**row, "stage_ms": row["stages"][stage]} for row in rows if row["stages"].get(stage, 0) > 0]
    _points(axes, had, "stage_ms")
    axes.set_title(stage, loc="left", fontsize=9)
    axes.set_xlabel("ms")
    least, most = axes.get_xlim()
    short = max(0.5 * (math.log(LEAST_SPAN) - math.log(most / least)), 0)
    axes.set_xlim(least * math.exp(-short), most * math.exp(short))
    if most > CROWDED * least:
        axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1,)))


def _hard(row: Row) -> bool:
    return str(row.get("scene", USUAL_SCENE)) != USUAL_SCENE


def _mode(row: Row) -> str:
    """Its shading, without how many lights."""
    return str(row["shade"]).partition(":")[0]


def _area(side: int) -> float:
    """Of the mark of a picture of so many pixels' side."""
    return 14 + 26 * (side / 512)


def _shown_db(row: Row) -> float:
    return min(float(row["psnr_db"]), CEILING_DB)


def _points(axes: Any, rows: list[Row], cost: str) -> None:
    import matplotlib.ticker

    for row in rows:
        colour, seeded = COLOURS.get(row["n"], "#333"), row["avatar"] == SEEDED
        axes.scatter(
            row[cost],
            _shown_db(row),
            s=_area(row["size"]),
            alpha=0.85,
            lw=EDGE,
            zorder=2,
            marker=HARD if _hard(row) else MARKERS[row["encoder"]],
            facecolor="none" if seeded else colour,
            edgecolor=colour if seeded else EDGES[_mode(row)],
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.grid(True, color="#eee", lw=0.6)
    axes.set_axisbelow(True)


def _label(row: Row) -> str:
    """What distinguishes a point, in few words."""
    words = [row["shade"]]
    words += [
        str(row[name]) for name, usual in USUAL.items() if row[name] != usual and name not in ("window", "threads")
    ]
    if row["window"] is not None:
        words.append(f"d={row['window']}")
    if _hard(row):
        words.append(row["scene"])
    if row["cull"] is not None:
        words.append(f"n·v ≥ {row['cull']:g}")
    if row["threads"] != USUAL["threads"]:
        words.append(f"{row['threads']} thread")
    return " · ".join(words)
