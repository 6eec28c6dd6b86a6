"""The speed–accuracy chart: every point, a Pareto front for each number of Gaussians, one panel for each stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rnd_bench.scenes.scenes import USUAL as USUAL_SCENE
from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path

from .grid import pareto
from .point import Row, Setting

BUDGET_MS, BUDGET_DB = 1000 / 60, 45.0
COLOURS = {4_000: "#7fb3d5", 8_000: "#2e86c1", 15_000: "#16a085", 30_000: "#d35400", 60_000: "#8e44ad"}
SEEDED = "seeded"  # ``avatar`` of a row with untrained networks
HARD = "X"  # marks a frame of one of the hardest scenes
EDGES = {"ao": "#aaaaaa", "table": "#000000", "table+sun": "#f4d03f", "lights": "#ff4fa3", "brute": "#00c8ff"}
"""of a mark: its shading"""
MARKERS = {"full": "o", "coarse": "s", "static": "^"}
EDGE = 0.9  # points wide
CEILING_DB = 60.0  # points above it are plotted on it
MIN_SPAN = 5.0  # a panel's greatest milliseconds over its least, at least: room for two of the ticks 1, 2, 5, 10 …
CROWDED = 500.0  # that ratio from which on only 0.1, 1, 10 … have room
COLUMNS, WIDE = 5, 3  # panels side by side, and how many of them the overview is as wide as


def check_chart(*files: Path) -> None:
    """Raise ``InputError`` unless all ``files`` are charts by their suffix and matplotlib is installed."""
    for file in files:
        if file.suffix not in (".svg", ".png"):
            raise InputError("--chart", expected=".svg or .png", got=file.name)
    if files:
        need_packages("bench", "matplotlib")


def draw_chart(rows: list[Row], files: Sequence[Path]) -> None:
    """Write the chart of ``rows`` to every file, SVG or PNG by its suffix; equal rows give equal bytes."""
    rows = [row for row in rows if "psnr_db" in row]
    if not rows:
        raise InputError("chart", expected="at least one measured point", got="none")
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    stages = list(dict.fromkeys(name for row in rows for name in row["stages"]))
    below = -(-len(stages) // COLUMNS)
    with matplotlib.rc_context({"svg.hashsalt": "rnd-bench", "font.size": 9, "svg.fonttype": "none"}):
        figure = plt.figure(figsize=(13, 5.4 + 2.5 * below), layout="constrained")
        grid = figure.add_gridspec(1 + below, COLUMNS, height_ratios=[2.2, *[1] * below])
        overview = figure.add_subplot(grid[0, :WIDE])
        _overview(overview, figure.add_subplot(grid[0, WIDE:]), rows)
        for k, stage in enumerate(stages):
            axes = figure.add_subplot(grid[1 + k // COLUMNS, k % COLUMNS], sharey=overview)
            _stage(axes, rows, stage)
            if k % COLUMNS == 0:
                axes.set_ylabel("dB")
            else:
                axes.tick_params(labelleft=False)
        for file in files:
            with atomic_path(file) as temporary:
                metadata: Row = {"Date": None} if file.suffix == ".svg" else {}
                figure.savefig(temporary, dpi=110, metadata=metadata)
        plt.close(figure)


def _overview(axes: Any, words: Any, rows: list[Row]) -> None:
    """All points, with the fronts of one image size and the usual scene; one front in ``words`` beside them."""
    usual, size = rows[0]["n"], rows[0]["size"]
    easy = [row for row in rows if row["size"] == size and not _hard(row)]
    fronts = {n: list(pareto([row for row in easy if row["n"] == n])) for n in COLOURS}
    for n, along in fronts.items():
        points = [r["ms_median"] for r in along], [_shown_db(r) for r in along]
        axes.plot(*points, color=COLOURS[n], lw=1, alpha=0.7, zorder=1)
    axes.axvline(BUDGET_MS, color="#999", lw=0.8, ls="--")
    axes.axhline(BUDGET_DB, color="#999", lw=0.8, ls="--")
    _points(axes, rows, "ms_median")
    named = [f"front of {usual:,} at {size}²:".replace(",", " ")]
    style = {"xytext": (0, 6), "textcoords": "offset points", "fontsize": 8, "ha": "center", "weight": "bold"}
    for number, row in enumerate(fronts.get(usual, []), 1):
        axes.annotate(str(number), (row["ms_median"], _shown_db(row)), **style)
        named.append(f"{number:2}  {_label(row)}: {row['ms_median']:.1f} ms, {row['psnr_db']:.1f} dB")
    words.axis("off")
    words.text(0, 1, "\n".join(named), transform=words.transAxes, fontsize=8, va="top", linespacing=1.5)
    axes.set_xlabel("ms per frame, pose to pixels (median); dashed: 60 frames a second")
    axes.set_ylabel(f"PSNR to the full reference, dB; dashed: 45; cut at {CEILING_DB:g}")
    axes.set_title(f"Speed against accuracy: {len(rows)} points on {rows[0]['machine']}", loc="left")
    handles = _legend(axes, rows)
    words.legend(handles=handles, loc="lower left", fontsize=8, frameon=False, borderaxespad=0, ncols=2)


def _legend(axes: Any, rows: list[Row]) -> list[Any]:

    def mark(label: str, **style: Any) -> Any:
        return axes.scatter([], [], label=label, **({"color": "#555"} if "edgecolor" not in style else {}) | style)

    numbers, modes = {row["n"] for row in rows}, {_mode(row) for row in rows}
    handles = [mark(f"{n:,} Gaussians".replace(",", " "), color=c) for n, c in COLOURS.items() if n in numbers]
    handles += [mark(f"encoder {name}", marker=marker) for name, marker in MARKERS.items()]
    handles += [
        mark(f"shade {mode}", facecolor="#ddd", edgecolor=edge, lw=EDGE)
        for mode, edge in EDGES.items()
        if mode in modes
    ]
    handles += [mark(f"{side}²", s=_area(side)) for side in sorted({row["size"] for row in rows})]
    if any(_hard(row) for row in rows):
        handles.append(mark(", ".join(row["scene"] for row in rows if _hard(row)), marker=HARD))
    if any(row["avatar"] == SEEDED for row in rows):
        handles.append(mark("hollow: an untrained avatar", facecolor="none", edgecolor="#555"))
    return handles


def _stage(axes: Any, rows: list[Row], stage: str) -> None:
    import matplotlib.ticker

    had = [{**row, "stage_ms": row["stages"][stage]} for row in rows if row["stages"].get(stage, 0) > 0]
    _points(axes, had, "stage_ms")
    axes.set_title(stage, loc="left", fontsize=9)
    axes.set_xlabel("ms")
    low, high = axes.get_xlim()
    short = max(0.5 * (math.log(MIN_SPAN) - math.log(high / low)), 0)
    axes.set_xlim(low * math.exp(-short), high * math.exp(short))
    if high > CROWDED * low:
        axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1,)))


def _hard(row: Row) -> bool:
    return str(row["scene"]) != USUAL_SCENE


def _mode(row: Row) -> str:
    return str(row["shade"]).partition(":")[0]


def _area(side: int) -> float:
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
    """The values of a point that differ from the usual."""
    usual = Setting()
    words = [row["shade"]]
    words += [str(row[name]) for name in ("encoder", "precision", "raster") if row[name] != getattr(usual, name)]
    if row["window"] is not None:
        words.append(f"d={row['window']}")
    if _hard(row):
        words.append(row["scene"])
    if row["cull"] is not None:
        words.append(f"n·v ≥ {row['cull']:g}")
    if row["threads"] != usual.threads:
        words.append(f"{row['threads']} thread")
    return " · ".join(words)
