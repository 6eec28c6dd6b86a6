"""The grid of the speed–accuracy chart: one factor at a time around the usual case and a crossed core, or factors that
are crossed with one another, all combinations of them or some drawn at random.

Every point is one row of JSON. Rows that are there already, measured on this machine, of the same files and by the same
code, are not measured again: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np

from rnd_bench.scenes.avatars import forget
from rnd_bench.scenes.scenes import HARDEST
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import earlier_rows, write_json
from rnd_runtime.playback.doctor import machine

from .point import FULL_N, Inputs, Row, Setting, measured

CULLS = (-0.2, -0.5)
"""cosines below which n·v is left out"""


FACTORS: dict[str, tuple[Any, ...]] = {
    "n": (4_000, 8_000, 15_000, FULL_N, 60_000),
    "size": (256, 512, 1024),
    "shade": ("ao", "table", "table+sun", "lights:32", "brute"),
    "encoder": ("full", "rates", "coarse", "static"),
    "precision": ("f32", "f16", "int8"),
    "window": (None, 2, 5),
    "raster": ("cpu", "gl-egl", "gl-osmesa"),
    "threads": (2, 1),
    "cull": (None, *CULLS),
}
"""what each field of a ``Setting`` is varied over"""


def settings(quick: bool = False, cross: Sequence[str] = (), sample: int | None = None) -> list[Setting]:
    """The points, the usual case first, none twice; with ``cross`` all combinations of those factors and no others.

    ``sample`` takes so many of these combinations, or of all factors', at random: see ``drawn``.

    Raises ``InputError`` for a factor that does not exist, and more points than there are combinations.
    """
    usual = Setting(n=8_000, size=256) if quick else Setting()
    factors = FACTORS
    for name in cross:
        check_option(name in FACTORS, "--cross", f"of {', '.join(FACTORS)}", name)
    check_option(len(set(cross)) == len(cross), "--cross", "each factor once", ",".join(cross))
    if cross or sample is not None:
        names = tuple(cross or FACTORS)
        combinations = product(*(FACTORS[name] for name in names))
        points = [usual, *(_of(usual, names, values) for values in combinations)]
        distinct = list(dict.fromkeys(points))
        if sample is None:
            return distinct
        check_option(0 < sample < len(distinct), "--sample", f"1 to {len(distinct) - 1} points", sample)
        return [usual, *islice(drawn(names, usual), sample)]
    if quick:
        factors = {
            "n": (4_000,),
            "shade": ("ao", "table"),
            "encoder": ("coarse", "static"),
            "threads": (1,),
            "raster": ("gl-egl",),
        }
    points = [usual, *(replace(usual, **{name: value}) for name, values in factors.items() for value in values)]
    if not quick:
        core = product((8_000, 15_000, FULL_N), FACTORS["encoder"], ("table", "table+sun"))
        points += [Setting(n=n, encoder=encoder, shade=shade) for n, encoder, shade in core]
        points += [Setting(shade="table", cull=cull) for cull in CULLS]
        points += [Setting(scene=name) for name in HARDEST]
    return list(dict.fromkeys(points))


def drawn(names: Sequence[str], usual: Setting, seed: int = 0) -> Iterator[Setting]:
    """Combinations of those factors' values at random, none twice and never the ``usual`` one.

    Each factor goes through its values again and again, in another order each time, so that every stretch of points has
    about as many of each; a longer sample begins with a shorter one.
    """
    rng = np.random.default_rng(seed)
    waiting: dict[str, list[Any]] = {name: [] for name in names}
    seen = {usual}
    while True:
        for name in names:
            if not waiting[name]:
                waiting[name] = [FACTORS[name][k] for k in rng.permutation(len(FACTORS[name]))]
        point = _of(usual, names, [waiting[name].pop() for name in names])
        if point not in seen:
            seen.add(point)
            yield point


def _of(usual: Setting, names: Sequence[str], values: Sequence[Any]) -> Setting:
    point = replace(usual, **dict(zip(names, values)))
    return replace(point, window=None) if point.encoder == "static" else point  # which looks at no window


def grid(
    inputs: Inputs,
    out: Path,
    *,
    quick: bool = False,
    cross: Sequence[str] = (),
    sample: int | None = None,
    fresh: bool = False,
    on_row: Callable[[Row, bool, int], None],
) -> list[Row]:
    """Measure what ``out`` does not hold yet, or with ``fresh`` everything; writes after each point.

    ``on_row(row, new, left)`` is called for every point; ``left`` are still to be measured.
    """
    inputs.checked()
    if fresh:
        forget(inputs.work)
    rows = [] if fresh else earlier_rows(out, what="rows of rnd-bench", names=("machine", *FACTORS))
    wanted, key = settings(quick, cross, sample), inputs.key()
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
            except InputError as error:  # no such rasteriser here: say so and go on
                row = {**asdict(setting), "machine": machine(), "failed": str(error)}
            row["inputs"], left = key, left - 1
        done.append(row)
        on_row(row, new, left)
        write_json(out, [*{_key(r): r for r in (*rows, *done)}.values()])
    return done


def pareto(rows: list[Row], cost: str = "ms_median", worth: str = "psnr_db") -> Iterator[Row]:
    """Rows that no other beats in both, by rising cost."""
    best = -1.0
    for row in sorted(rows, key=lambda row: (row[cost], -row[worth])):
        if row[worth] > best:
            best = row[worth]
            yield row


def _key(row: Row) -> tuple[Any, ...]:
    return tuple(row.get(name, usual) for name, usual in asdict(Setting()).items())  # older rows have no scene
