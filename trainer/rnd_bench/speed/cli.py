"""``rnd-bench raster, frame, grid, step, scenes, compare``: measure, print tables, write rows."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.table import Table

from rnd_bench.options import Compare, Files, Frame, Grid, Raster, Scenes, Step
from rnd_bench.scenes.scenes import USUAL
from rnd_runtime.cli.command import show
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.errors import check_cull, check_option, flag
from rnd_runtime.core.files import earlier_rows, existing_file, sha256_of, write_json
from rnd_runtime.core.threads import check_threads, max_threads, set_threads
from rnd_runtime.playback.doctor import machine


def run_raster(options: Raster) -> None:
    from .raster import bench_raster

    _check(options, "n", "size", "repeats")
    rows = bench_raster(options.n, options.size, options.repeats, options.threads)
    _write(options.json, rows)
    heads = ("kernel", "pass", "ms median", "ms p95", "PSNR dB", "gradient rel. L2")
    table = Table(*heads, title=f"{options.n} Gaussians, {options.size}²")
    for row in rows:
        gradient = "" if row["grad_rel_l2"] is None else f"{row['grad_rel_l2']:.1e}"
        times = (f"{row['ms_median']:.2f}", f"{row['ms_p95']:.2f}")
        table.add_row(row["kernel"], row["pass"], *times, f"{row['psnr_db']:.1f}", gradient)
    Console().print(table)


def run_frame(options: Frame) -> None:
    from rnd_runtime.shading.shader import check_mode

    from .point import Setting, measured

    _check(options, "n", "size", "runs")
    check_cull(options.cull)
    check_mode(options.shade)
    given = {name: getattr(options, name) for name in Setting.__dataclass_fields__}
    setting = Setting(**given | {"threads": _threads(options.threads)})
    inputs, rows = _inputs(options.files), list[dict[str, Any]]()
    for _ in range(options.runs):
        row = measured(setting, inputs, seconds=6.0, compare=not options.no_compare, file=options.avatar)
        rows.append(row)
        _write(options.json, rows if options.runs > 1 else row)
        show(_line(row))
        for name, milliseconds in row["stages"].items():
            show(f"  {name:16} {milliseconds:6.2f} ms")
    if options.runs > 1:
        for column, what in {"ms_median": "median", "ms_p95": "p95", "cold_start_ms": "cold start"}.items():
            values = sorted(float(each[column]) for each in rows)
            middle = statistics.median(values)
            show(f"{what} of {len(rows)} runs: {values[0]:.1f} to {values[-1]:.1f} ms, median {middle:.1f}")


def run_grid(options: Grid) -> None:
    from .chart import check_chart, draw_chart
    from .grid import grid

    _check(options)
    check_chart(*options.chart)
    cross = [name.strip() for name in options.cross.split(",")] if options.cross else []
    done: list[float] = []  # times at which new points were done; the first is no measure, as it compiles kernels

    def on_row(row: dict[str, Any], new: bool, left: int) -> None:
        state = f"{left} left" if new else "stored"
        if new:
            done.append(perf_counter())
        if new and len(done) > 1:
            state += f", about {(done[-1] - done[0]) / 60 * left / (len(done) - 1):.0f} min"
        show(f"{_line(row)}  ({state})")

    inputs = _inputs(options.files)
    rows = grid(inputs, options.json, quick=options.quick, cross=cross, fresh=options.fresh, on_row=on_row)
    draw_chart(rows, options.chart)
    show(f"{options.json}, {', '.join(map(str, options.chart))}")
    others = len(earlier_rows(options.json, what="rows of rnd-bench", names=())) - len(rows)
    if others:
        show(f"{options.json} also holds {others} points of earlier grids, not in the chart (--fresh drops them)")


def run_step(options: Step) -> None:
    from rnd_runtime.capture.capture import load_capture
    from rnd_trainer.config import preset
    from rnd_trainer.losses.perceptual import load_lpips

    from .step import bench_step

    _check(options, "repeats")
    perceptual, capture = load_lpips(options.perceptual_weights), load_capture(options.capture)
    with Progress() as progress:
        progress.phase("training")
        config = preset(options.preset)
        rows = bench_step(capture, config, perceptual, repeats=options.repeats, on_step=progress.update)
    _write(options.json, rows)
    table = Table("what", "ms", "share", title=f"{rows[0]['gaussians']} Gaussians")
    for row in rows:
        table.add_row(row["what"], f"{row['ms']:.1f}", f"{row['share']:.0%}")
    Console().print(table)


def run_scenes(options: Scenes) -> None:
    from .scenes import bench_scenes

    _check(options, "repeats")
    avatar, motion, light = (
        existing_file(file, what=what)
        for file, what in ((options.avatar, "avatar"), (options.motion, "motion"), (options.hdr, "light"))
    )
    threads = _threads(options.threads)
    set_threads(threads)
    about = {"avatar_sha256": sha256_of(options.avatar), "machine": machine(), "threads": threads}
    rows: dict[str, list[dict[str, Any]]] = {}

    def on_row(kind: str, row: dict[str, Any]) -> None:
        rows.setdefault(kind, []).append(row | about)
        _write(options.json, rows)
        numbers = {name: value for name, value in row.items() if isinstance(value, int | float)}
        show(f"{kind:9}" + "  ".join(f"{name} {value:.4g}" for name, value in numbers.items()))

    bench_scenes(avatar, motion, light, options.repeats, on_row)


def run_compare(options: Compare) -> None:
    from .compare import FRAMES, Checkout, compare

    _check(options, "pairs", "size")
    named = {"avatar": options.avatar, "motion": options.motion, "light": options.hdr}
    files = [existing_file(file, what=what) for what, file in named.items()]
    checkouts: list[Checkout] = []
    threads = _threads(options.threads)
    try:
        for folder in (options.before, options.after):
            checkouts.append(Checkout(folder, files, options.shade, options.size, threads))
        with Progress() as progress:
            progress.phase("pairs of frames", options.pairs)
            rows = compare(checkouts, options.pairs, progress.update)
    finally:
        for checkout in checkouts:
            checkout.close()
    about: dict[str, Any] = {name: checkout.commit for name, checkout in zip(("before", "after"), checkouts)}
    about |= {"avatar_sha256": sha256_of(options.avatar), "machine": machine(), "frames": FRAMES, "threads": threads}
    about |= {name: getattr(options, name) for name in ("size", "shade", "pairs")}
    _write(options.json, [row | about for row in rows])
    table = Table("stage", "before ms", "after ms", "ratio")
    for row in rows:
        times = (f"{row['before_ms']:.2f}", f"{row['after_ms']:.2f}")
        table.add_row(row["stage"], *times, f"{row['ratio']:.3f} ± {row['ratio_se']:.3f}")
    Console().print(table)


def _line(row: dict[str, Any]) -> str:
    window = "" if row["window"] is None else f" d={row['window']}"
    cull = "" if row["cull"] is None else f", n·v ≥ {row['cull']:g}"
    hard = "" if row["scene"] == USUAL else f", {row['scene']}"
    words = f"{row['n']:6} {row['size']:4}² {row['shade']:9} {row['encoder']}{window} {row['precision']} "
    words += f"{row['raster']} {row['threads']} threads{cull}{hard}: "
    if "failed" in row:
        return words + row["failed"]
    words += f"{row['ms_median']:.1f} ms (p95 {row['ms_p95']:.1f}), "
    words += f"{row['peak_mb']:.0f} MB, file {row['file_mb']:.1f} MB"
    if "psnr_db" in row:
        words += f", {row['psnr_db']:.1f} dB (worst {row['psnr_db_worst']:.1f})"
    if "psnr_suns_db" in row:
        words += f", with the same shadows {row['psnr_suns_db']:.1f} ({row['psnr_suns_db_worst']:.1f})"
    return words


def _threads(wanted: int | None) -> int:
    """By default two, where there are two cores."""
    return wanted or min(2, max_threads())


def _check(options: Any, *counts: str) -> None:
    for name in counts:
        check_option(getattr(options, name) >= 1, flag(name), "at least 1", getattr(options, name))
    if getattr(options, "threads", None) is not None:
        check_threads(options.threads)


def _inputs(files: Files) -> Any:
    from .point import Inputs

    body, motion, hdr = (files.assets / name for name in ("body.npz", "walk.npz", "sky.exr"))
    return Inputs(body, motion, hdr, files.work, files.checkpoint).checked()


def _write(file: Path | None, value: Sequence[Any] | dict[str, Any]) -> None:
    if file is not None:
        write_json(file, value)
