"""The grid of the speed–accuracy chart: one factor at a time around the usual case and a crossed core, or factors that
are crossed with one another, all combinations of them or some drawn at random.

Every point is one row of JSON. Rows that are there already, measured on this machine, of the same files and by the same
code, are not measured again: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime import __version__
from rnd_runtime.doctor import machine
from rnd_runtime.errors import InputError, check_option
from rnd_runtime.files import earlier_rows, existing_file, output_folder, write_json

from .bench_avatars import (
    Encoders,
    checkpoint_model,
    content_key,
    exported,
    forget,
    seeded_checkpoint,
    sources,
)
from .bench_frame import Point, measure
from .bench_reference import Reference, errors, reference
from .bench_scenes import HARDEST, USUAL, Scene, scene

FULL_N = 30_000
CULLS = (-0.2, -0.5)
"""cosines below which n·v is left out"""
Row = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """One point: everything that is varied."""

    n: int = FULL_N
    size: int = 512
    shade: str = "table+sun"
    encoder: str = "full"
    window: int | None = None
    precision: str = "f32"
    raster: str = "cpu"
    threads: int = 2
    cull: float | None = None
    scene: str = USUAL


@dataclass(frozen=True)
class Inputs:
    """Files that the points share. Of ``checkpoints`` each stands in for the seeded avatar where N is its own."""

    body: Path
    motion: Path
    hdr: Path
    work: Path
    checkpoints: tuple[Path, ...] = ()

    def checked(self) -> Inputs:
        """Refuse missing files, and two checkpoints for one N, before minutes are spent."""
        for what, file in (("body", self.body), ("motion", self.motion), ("light", self.hdr)):
            existing_file(file, what=what)
        by_size: dict[int, Path] = {}
        for file in self.checkpoints:
            n = checkpoint_model(existing_file(file, what="checkpoint"))["gaussians"]
            check_option(
                n not in by_size, "--checkpoint", f"one avatar of {n} Gaussians", f"{by_size.get(n)}, {file}"
            )
            by_size[n] = file
        output_folder(self.work)
        return self

    def key(self) -> str:
        """What tells rows of these files, by this code, from rows of others."""
        code = (*sources("rnd_runtime"), *sources("rnd_export"))
        return content_key(self.body, self.motion, self.hdr, *(self.checkpoints or ("none",)), *code)

    def scene(self, name: str) -> Scene:
        """The scene ``name`` of :mod:`bench_scenes`."""
        key = content_key(self.body, self.motion, *sources("rnd_trainer"))
        return scene(name, self.body, self.motion, self.hdr, self.work, key)

    def source(self, n: int) -> tuple[Path, str]:
        """The checkpoint of ``n`` Gaussians, and which it is: trained or seeded."""
        for file in self.checkpoints:
            if checkpoint_model(file)["gaussians"] == n:
                return file, "trained"
        return seeded_checkpoint(n, self.body, self.work), "seeded"

    def avatar(self, n: int, encoders: Encoders) -> tuple[Path, str]:
        """The file, and which avatar it is."""
        checkpoint, which = self.source(n)
        return exported(checkpoint, encoders, self.work), which


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
"""what each field of a :class:`Setting` is varied over"""


def settings(quick: bool = False, cross: Sequence[str] = (), sample: int | None = None) -> list[Setting]:
    """The points, the usual case first, none twice; with ``cross`` all combinations of those factors and no others.

    ``sample`` takes so many of these combinations, or of all factors', at random: see :func:`drawn`.

    Raises :class:`InputError` for a factor that does not exist, and more points than there are combinations.
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
        factors = {"n": (4_000,), "shade": ("ao", "table"), "encoder": ("coarse", "static"), "threads": (1,),
                   "raster": ("gl-egl",)}  # fmt: skip
    points = [
        usual,
        *(replace(usual, **{name: value}) for name, values in factors.items() for value in values),
    ]
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


def measured(
    setting: Setting,
    inputs: Inputs,
    *,
    seconds: float = 4.0,
    compare: bool = True,
    with_suns: bool = True,
    full_n: int | None = None,
) -> Row:
    """One row: the setting, times and sizes, and the errors against the whole avatar's reference.

    ``psnr_full_db`` compares the pictures with those of the same kind of avatar with ``full_n`` Gaussians: seeded
    ones follow one formula, and trained ones one capture, so that is what fewer Gaussians cost. Of ``table+sun``,
    ``psnr_suns_db`` and ``psnr_suns_db_worst`` compare with the reference whose suns cast the same shadows; that
    reference takes twice as long as the other and is left out without ``with_suns``.
    """
    encoders = Encoders(setting.encoder, setting.precision, setting.window)
    file, which = inputs.avatar(setting.n, encoders)
    filmed = inputs.scene(setting.scene)
    point = Point(
        str(file), str(filmed.motion), str(filmed.hdr), setting.size, setting.shade, setting.raster,
        setting.threads, seconds=seconds, cull=setting.cull, view=filmed.view,
    )  # fmt: skip
    truths: dict[str, Reference] = {}
    with ThreadPoolExecutor(1) as other:
        # a cold start is one of a machine whose numba cache has the kernels: what it lacks is compiled meanwhile
        compiled = other.submit(measure, replace(point, frames=1))
        if compare:
            whole, _ = inputs.avatar(setting.n, Encoders())
            truths[""] = reference(whole, filmed, setting.size, inputs.work)
            if setting.shade == "table+sun" and with_suns:
                truths["suns"] = reference(whole, filmed, setting.size, inputs.work, with_suns=True)
            largest, kind = inputs.avatar(full_n or setting.n, Encoders())
            if kind == which:
                truths["full"] = reference(largest, filmed, setting.size, inputs.work)
        compiled.result()
    drawn = measure(point)
    row: Row = {**asdict(setting), "avatar": which, **drawn.row, "machine": machine(), "version": __version__}
    if compare:
        row |= errors(drawn, truths[""])
    if "suns" in truths:
        off = errors(drawn, truths["suns"])
        row |= {f"psnr_suns_db{part}": off[f"psnr_db{part}"] for part in ("", "_worst")}
    if "full" in truths:
        row["psnr_full_db"], row["full_n"] = errors(drawn, truths["full"])["psnr_db"], full_n or setting.n
    return row


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
                row = measured(
                    setting, inputs, seconds=2.0 if quick else 4.0, with_suns=not quick, full_n=wanted[0].n
                )
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
    return tuple(
        row.get(name, usual) for name, usual in asdict(Setting()).items()
    )  # older rows have no scene
