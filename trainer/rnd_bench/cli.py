"""rnd-bench: time and error of the same calls, as JSON rows."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import tyro

from rnd_bench.scenes.scenes import USUAL
from rnd_runtime.core.console import print_plain
from rnd_runtime.core.errors import check_cull, check_option, flag, parse_options, run_command
from rnd_runtime.core.files import earlier_rows, write_json

from .options import Files, Frame, Grid, Peers, Raster, Shards, Step

_DESCRIPTION = """Time and error of the same calls. Without the name of a command it is grid: rnd-bench --quick is the
small grid. --stability runs the stability list."""


def main() -> None:
    """Entry point of ``rnd-bench``."""
    if sys.argv[1:2] == ["--stability"]:
        from rnd_bench.stability.table import stability_main

        sys.exit(stability_main(sys.argv[2:]))
    commands: dict[str, tuple[Any, Callable[[Any], None]]] = {
        "raster": (Raster, _raster),
        "frame": (Frame, _frame),
        "grid": (Grid, _grid),
        "peers": (Peers, _peers),
        "shards": (Shards, _shards),
        "step": (Step, _step),
    }
    kinds = {name: kind for name, (kind, _) in commands.items()}
    words = sys.argv[1:]
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["grid", *words]

    def command() -> None:
        options = parse_options(
            lambda: tyro.extras.subcommand_cli_from_dict(kinds, prog="rnd-bench", args=words, description=_DESCRIPTION)
        )
        run = next(run for kind, run in commands.values() if isinstance(options, kind))
        run(options)

    sys.exit(run_command("rnd-bench", command))


def _raster(options: Raster) -> None:
    _prepare(options, "n", "size", "repeats")
    from rich.console import Console
    from rich.table import Table

    from rnd_bench.speed.raster import bench_raster

    rows = bench_raster(options.n, options.size, options.repeats, options.threads)
    table = Table(
        "kernel",
        "pass",
        "ms median",
        "ms p95",
        "PSNR dB",
        "gradient rel. L2",
        title=f"{options.n} Gaussians, {options.size}²",
    )
    for row in rows:
        gradient = row["grad_rel_l2"]
        table.add_row(
            row["kernel"],
            row["pass"],
            f"{row['ms_median']:.2f}",
            f"{row['ms_p95']:.2f}",
            f"{row['psnr_db']:.1f}",
            "" if gradient is None else f"{gradient:.1e}",
        )
    _write(options.json, rows)
    Console().print(table)


def _frame(options: Frame) -> None:
    _prepare(options, "n", "size", "threads", "runs")
    check_cull(options.cull)
    from rich.console import Console

    from rnd_bench.speed.point import Setting, measured
    from rnd_runtime.shading.shader import check_mode

    check_mode(options.shade)
    setting = Setting(
        options.n,
        options.size,
        options.shade,
        options.encoder,
        options.window,
        options.precision,
        options.raster,
        options.threads,
        options.cull,
        options.scene,
    )
    inputs, console, rows = _inputs(options.files), Console(), []
    for _ in range(options.runs):
        row = measured(setting, inputs, seconds=6.0, compare=options.compare, file=options.avatar)
        rows.append(row)
        # before anything is printed: who reads it may stop reading
        _write(options.json, rows if options.runs > 1 else row)
        print_plain(console, _line(row))
        for name, milliseconds in row["stages"].items():
            console.print(f"  {name:16} {milliseconds:6.2f} ms")
    if options.runs > 1:
        for name, what in {"ms_median": "median", "ms_p95": "p95", "cold_start_ms": "cold start"}.items():
            values = sorted(row[name] for row in rows)
            middle = statistics.median(values)
            spread = f"{values[0]:.1f} to {values[-1]:.1f} ms, in the middle {middle:.1f}"
            console.print(f"{what} of {len(rows)} runs: {spread}")


def _grid(options: Grid) -> None:
    _prepare(options)
    from rich.console import Console

    from rnd_bench.speed.chart import draw_chart
    from rnd_bench.speed.grid import grid

    from .charts import check_chart

    check_chart(*options.chart)
    cross = [name.strip() for name in options.cross.split(",")] if options.cross else []
    console, done = Console(), list[float]()
    # when each new point was; the first one's time is no other's: kernels are compiled, references made

    def show(row: dict[str, Any], new: bool, left: int) -> None:
        state = f"{left} left" if new else "kept"
        if new:
            done.append(perf_counter())
        if new and len(done) > 1:
            minutes = (done[-1] - done[0]) / 60 * left / (len(done) - 1)
            state += f", about {minutes:.0f} min"
        print_plain(console, f"{_line(row)}  ({state})")

    rows = grid(
        _inputs(options.files),
        options.json,
        quick=options.quick,
        cross=cross,
        sample=options.sample,
        fresh=options.fresh,
        on_row=show,
    )
    draw_chart(rows, list(options.chart))
    console.print(f"{options.json}, {', '.join(map(str, options.chart))}", markup=False, emoji=False, soft_wrap=True)
    others = len(earlier_rows(options.json, what="rows of rnd-bench", names=())) - len(rows)
    if others:
        console.print(
            f"{options.json} also keeps {others} points of earlier grids, not in the chart (--fresh drops them)",
            markup=False,
            emoji=False,
            soft_wrap=True,
        )


def _peers(options: Peers) -> None:
    _prepare(options, "n", "size", "threads")
    from rich.console import Console
    from rich.table import Table

    from rnd_bench.scenes.avatars import Encoders, exported
    from rnd_bench.speed.growth import Amounts, growth
    from rnd_bench.speed.peers import bench_peers

    inputs = _inputs(options.files)
    checkpoint = inputs.source(options.n)[0]
    avatar = exported(checkpoint, Encoders(), inputs.work)
    rows = bench_peers(checkpoint, avatar, options.n, options.size, options.threads)
    table = Table("stage", "peer", "ms median", "ms p95")
    for row in rows:
        timed = "ms_median" in row
        cells = [f"{row[key]:.2f}" for key in ("ms_median", "ms_p95")] if timed else [str(row["failed"]), ""]
        table.add_row(str(row["stage"]), str(row["peer"]), *cells)
    slopes = growth(inputs, Amounts(), options.size, options.threads)
    grown = Table("stage", "grows with", "ms", "exponent", "floor ms at the last")
    for row in slopes:
        times = ", ".join(f"{a}: {ms:.2f}" for a, ms in zip(row["amounts"], row["ms"]))
        grown.add_row(row["stage"], row["of"], times, f"{row['exponent']:.2f}", f"{row['floor_ms']:.2f}")
    console = Console()
    console.print(table)
    console.print(grown)
    _write(options.json, {"peers": rows, "growth": slopes})


def _shards(options: Shards) -> None:
    _prepare(options, "frames", "size", "cores")
    from rich.console import Console
    from rich.table import Table

    from rnd_bench.speed.shards import bench_shards

    files = (options.avatar, options.motion, options.hdr)
    rows = list(bench_shards(*files, options.frames, options.size, options.cores))
    table = Table("processes", "threads", "seconds", "frames/s", "speed-up")
    for row in rows:
        cells = (f"{row['seconds']:.2f}", f"{row['fps']:.1f}", f"{row['speed_up']:.2f}")
        table.add_row(str(row["processes"]), str(row["threads"]), *cells)
    _write(options.json, rows)
    Console().print(table)


def _step(options: Step) -> None:
    _prepare(options, "repeats")
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from rnd_bench.speed.step import bench_step
    from rnd_runtime.capture.capture import load_capture
    from rnd_trainer.config import preset
    from rnd_trainer.losses.perceptual import load_lpips

    perceptual = load_lpips(options.perceptual_weights)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("training")
        rows = bench_step(
            load_capture(options.capture),
            preset(options.preset),
            perceptual,
            repeats=options.repeats,
            on_step=lambda done, total: progress.update(task, completed=done, total=total),
        )
    table = Table("what", "ms", "share", title=f"{rows[0]['gaussians']} Gaussians")
    for row in rows:
        table.add_row(row["what"], f"{row['ms']:.1f}", f"{row['share']:.0%}")
    _write(options.json, rows)
    Console().print(table)


def _line(row: dict[str, Any]) -> str:
    """A row in words."""
    window = "" if row["window"] is None else f" d={row['window']}"
    cull = "" if row["cull"] is None else f", n·v ≥ {row['cull']:g}"
    hard = "" if row["scene"] == USUAL else f", {row['scene']}"
    words = (
        f"{row['n']:6} {row['size']:4}² {row['shade']:9} {row['encoder']}{window} {row['precision']} {row['raster']} "
        f"{row['threads']} threads{cull}{hard}: "
    )
    if "failed" in row:
        return words + row["failed"]
    words += f"{row['ms_median']:.1f} ms (p95 {row['ms_p95']:.1f}), "
    words += f"{row['peak_mb']:.0f} MB, file {row['file_mb']:.1f} MB"
    if "psnr_db" in row:
        words += f", {row['psnr_db']:.1f} dB (worst {row['psnr_db_worst']:.1f})"
    if "psnr_suns_db" in row:
        words += f", behind the same shadows {row['psnr_suns_db']:.1f} ({row['psnr_suns_db_worst']:.1f})"
    return words


def _prepare(options: Any, *counts: str) -> None:
    from rnd_trainer.commands.eval import need_extra

    need_extra()
    for name in counts:
        check_option(getattr(options, name) >= 1, flag(name), "at least 1", getattr(options, name))
    if getattr(options, "threads", None) is not None:
        from rnd_runtime.core.threads import check_threads

        check_threads(options.threads)


def _inputs(files: Files) -> Any:
    from rnd_bench.speed.point import Inputs

    return Inputs(files.body, files.motion, files.hdr, files.work, files.checkpoint).checked()


def _write(file: Path | None, value: Any) -> None:
    if file is not None:
        write_json(file, value)
