"""The grid of the speed–accuracy chart: one factor at a time and a crossed core, or all combinations of given factors.

Every point is one row of JSON. Rows of the same machine, files and code are not measured again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

from rnd_bench.scenes.avatars import forget
from rnd_bench.scenes.scenes import HARDEST
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import earlier_rows, write_json
from rnd_runtime.playback.doctor import machine

from .point import FULL_N, Inputs, Row, Setting, measured

CULLS = (-0.2, -0.5)  # cosines below which n·v is left out
FACTORS: dict[str, tuple[Any, ...]] = {
    "n": (4_000, 8_000, 15_000, FULL_N, 60_000),
    "size": (256, 512, 1024),
    "shade": ("ao", "table", "table+sun", "lights:32", "brute"),
    "encoder": ("full", "coarse", "static"),
    "precision": ("f32", "f16", "int8"),
    "window": (None, 2, 5),
    "raster": ("cpu", "gl-egl", "gl-osmesa"),
    "threads": (2, 1),
    "cull": (None, *CULLS),
}
"""values of each field of a ``Setting``"""


QUICK: dict[str, tuple[Any, ...]] = {
    "n": (4_000,),
    "shade": ("ao", "table"),
    "encoder": ("coarse", "static"),
    "threads": (1,),
    "raster": ("gl-egl",),
}


def settings(quick: bool = False, cross: Sequence[str] = ()) -> list[Setting]:
    """The points, the usual case first, none twice; with ``cross`` all combinations of those factors."""
    usual = Setting(n=8_000, size=256) if quick else Setting()
    for name in cross:
        check_option(name in FACTORS, "--cross", f"of {', '.join(FACTORS)}", name)
    check_option(len(set(cross)) == len(cross), "--cross", "each factor once", ",".join(cross))
    if cross:
        points = [replace(usual, **dict(zip(cross, values))) for values in product(*(FACTORS[name] for name in cross))]
        windowed = [replace(point, window=None) if point.encoder == "static" else point for point in points]
        return list(dict.fromkeys([usual, *windowed]))
    factors = QUICK if quick else FACTORS
    points = [usual, *(replace(usual, **{name: value}) for name, values in factors.items() for value in values)]
    if not quick:
        core = product((8_000, 15_000, FULL_N), FACTORS["encoder"], ("table", "table+sun"))
        points += [Setting(n=n, encoder=encoder, shade=shade) for n, encoder, shade in core]
        points += [Setting(shade="table", cull=cull) for cull in CULLS]
        points += [Setting(scene=name) for name in HARDEST]
    return list(dict.fromkeys(points))


def grid(
    inputs: Inputs,
    out: Path,
    *,
    quick: bool = False,
    cross: Sequence[str] = (),
    fresh: bool = False,
    on_row: Callable[[Row, bool, int], None],
) -> list[Row]:
    """Measure the points missing in ``out``, or with ``fresh`` all; write ``out`` after each.

    ``on_row(row, new, left)`` is called for every point, with the number still to be measured.
    """
    inputs.checked()
    if fresh:
        forget(inputs.work)
    rows = [] if fresh else earlier_rows(out, what="rows of rnd-bench", names=("machine", *FACTORS))
    wanted, key = settings(quick, cross), inputs.key()
    here = {
        _key(row): row
        for row in rows
        if row["machine"] == machine() and row.get("inputs") == key and "failed" not in row
    }
    done: list[Row] = []
    left = sum(_key(asdict(setting)) not in here for setting in wanted)
    for setting in wanted:
        row = here.get(_key(asdict(setting)))
        new = row is None
        if row is None:
            try:
                row = measured(setting, inputs, seconds=2.0 if quick else 4.0, with_suns=not quick, full_n=wanted[0].n)
            except InputError as error:  # such as a missing rasteriser
                row = {**asdict(setting), "machine": machine(), "failed": str(error)}
            row["inputs"], left = key, left - 1
        done.append(row)
        on_row(row, new, left)
        write_json(out, [*{_key(r): r for r in (*rows, *done)}.values()])
    return done


def pareto(rows: list[Row]) -> Iterator[Row]:
    """Rows that no other beats in both time and PSNR, by rising time."""
    best = -1.0
    for row in sorted(rows, key=lambda row: (row["ms_median"], -row["psnr_db"])):
        if row["psnr_db"] > best:
            best = row["psnr_db"]
            yield row


def _key(row: Row) -> tuple[Any, ...]:
    return tuple(row.get(name) for name in asdict(Setting()))
