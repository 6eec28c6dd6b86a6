"""Charts as SVG and PNG: the same bytes for the same rows; and that of the held-out PSNR against training time."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path

Row = dict[str, Any]


def check_chart(*files: Path) -> None:
    """Raise ``InputError`` unless all ``files`` are charts by their suffix, and matplotlib can draw them."""
    for file in files:
        if file.suffix not in (".svg", ".png"):
            raise InputError("--chart", expected=".svg or .png", got=file.name)
    if files and importlib.util.find_spec("matplotlib") is None:
        hint = 'needs the extra: pip install "rnd-avatar[bench]", in a clone ".[bench]"'
        raise InputError("matplotlib is not installed", hint=hint)


@contextmanager
def chart(files: Sequence[Path], size: tuple[float, float]) -> Iterator[Any]:
    """A matplotlib figure of ``size`` inches, written to every file, SVG or PNG by its suffix, when the block ends.

    ``check_chart`` has found matplotlib, before what is drawn was measured.
    """
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    with matplotlib.rc_context({"svg.hashsalt": "rnd-bench", "font.size": 9, "svg.fonttype": "none"}):
        figure = plt.figure(figsize=size, layout="constrained")
        yield figure
        for file in files:
            with atomic_path(file) as temporary:
                metadata: Row = {"Date": None} if file.suffix == ".svg" else {}
                figure.savefig(temporary, dpi=110, metadata=metadata)
        plt.close(figure)


MARKERS = "osD^v*"
"""of trainings of one kind, in the order in which they come"""


def draw_lengths(rows: Sequence[Row], files: Sequence[Path]) -> None:
    """PSNR of every split against minutes of training, of ``rnd-eval --ablate --study lengths``.

    A point is a training of its own, with its own schedule; the mean over seeds, with their range. A line joins
    trainings that differ in their length alone, those whose names (``1/4``, ``5, as it was``) end alike after the
    comma. The title names every machine that any of them was trained on.
    """
    kinds = list(dict.fromkeys(_kind(row) for row in rows))
    with chart(files, (7.5, 4.4)) as figure:
        from matplotlib.ticker import LogLocator, NullFormatter  # here, as of an extra

        axes = figure.add_subplot()
        for colour, split in enumerate(dict.fromkeys(row["split"] for row in rows)):
            axes.plot([], [], color=f"C{colour}", lw=1, label=split)
            for marker, kind in zip(cycle(MARKERS), kinds):
                own = [row for row in rows if row["split"] == split and _kind(row) == kind]
                if own:
                    _draw_line(axes, own, f"C{colour}", marker)
        if len(kinds) > 1:
            for marker, kind in zip(cycle(MARKERS), kinds):
                axes.plot([], [], marker, color="#666", ms=4, label=kind or "the others")
        first = rows[0]
        what = f"{first['gaussians']:,} Gaussians".replace(",", " ")
        machines = sorted({row.get("train_machine") or row["machine"] for row in rows})
        axes.set_title(f"Held-out PSNR against training time: {what}\n{'; '.join(machines)}", loc="left")
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("minutes of training")
        axes.set_ylabel("dB")
        axes.grid(True, color="#eee", lw=0.6)
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))


def _kind(row: Row) -> str:
    """What a training is beside its length."""
    return str(row["method"].partition(", ")[2])


def _draw_line(axes: Any, rows: Sequence[Row], colour: str, marker: str) -> None:
    points = []
    for method in dict.fromkeys(row["method"] for row in rows):
        of = [row for row in rows if row["method"] == method]
        figures = [row["psnr"] for row in of]
        points.append((sum(row["minutes"] for row in of) / len(of), sum(figures) / len(of), figures))
    minutes, means, spreads = zip(*sorted(points))
    low = [mean - min(figures) for mean, figures in zip(means, spreads)]
    high = [max(figures) - mean for mean, figures in zip(means, spreads)]
    style = {"color": colour, "marker": marker, "ms": 4, "lw": 1, "capsize": 2}
    axes.errorbar(minutes, means, yerr=(low, high), **style)
