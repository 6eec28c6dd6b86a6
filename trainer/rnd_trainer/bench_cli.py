"""rnd-bench: time and error of the same calls, as JSON rows."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from rnd_runtime.errors import InputError, run_command
from rnd_runtime.files import atomic_path


@dataclass(frozen=True)
class Files:
    """What is drawn; the defaults are those of a clone."""

    checkpoint: Path | None = None
    """a trained avatar.ckpt, used where N is its own; elsewhere a seeded, untrained avatar on the body stands in"""
    body: Path = Path("assets/body.npz")
    """of the seeded avatar"""
    motion: Path = Path("assets/walk.npz")
    """how it moves"""
    hdr: Path = Path("assets/sky.exr")
    """and what lights it"""
    work: Path = Path(".cache/bench")
    """folder in which avatars and references are kept between runs"""


@dataclass(frozen=True)
class Raster:
    """The CPU and GL rasterisers against a plain-torch tile rasteriser, with their errors to the oracle."""

    json: Path | None = None
    """write the rows here"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    repeats: int = 40
    """timed calls of each kernel; the slow reference gets a tenth of them"""
    threads: int | None = None
    """of numba and torch; by default one per core"""


@dataclass(frozen=True)
class Frame:
    """One point: a frame from pose to pixels, all stages, with its error against the full reference."""

    json: Path | None = None
    """write the row here"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    shade: str = "table+sun"
    """ao, table, table+sun, lights:K or brute"""
    encoder: Literal["full", "coarse", "static"] = "full"
    """as of rnd-export"""
    precision: Literal["f32", "f16", "int8"] = "f32"
    """as of rnd-export"""
    window: int | None = None
    """poses in the motion window; by default the checkpoint's"""
    raster: Literal["cpu", "gl-egl", "gl-osmesa"] = "cpu"
    """what splats"""
    threads: int = 2
    """of onnxruntime and of the kernels"""
    compare: bool = True
    """measure the error too: the reference takes half a minute the first time"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Grid:
    """Every point of the speed–accuracy chart, each in a process of its own; resumes; draws the chart."""

    quick: bool = False
    """the small grid, in two minutes"""
    json: Path = Path("assets/bench/grid.json")
    """rows; those measured on this machine are not measured again"""
    chart: tuple[Path, ...] = (Path("assets/bench/grid.svg"), Path("assets/bench/grid.png"))
    """the chart, SVG or PNG by suffix"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Peers:
    """The same work done by others, side by side, and how each stage's time grows, with the floor beside it."""

    json: Path | None = None
    """write the rows here"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    threads: int = 2
    """of everybody"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Shards:
    """One clip by one process, by several threads, and by several processes with a part each."""

    json: Path | None = None
    """write the rows here"""
    avatar: Path = Path("assets/avatar.onnx")
    """what is played"""
    motion: Path = Path("assets/walk.npz")
    """how it moves"""
    hdr: Path = Path("assets/sky.exr")
    """and what lights it"""
    frames: int = 120
    """of the clip, from its start"""
    size: int = 512
    """picture side in pixels"""
    cores: int = 2
    """processes, or threads, at most"""


def main() -> None:
    """Entry point of ``rnd-bench``."""
    if sys.argv[1:2] == ["--stability"]:
        from .bench_stability import stability_main

        sys.exit(stability_main(sys.argv[2:]))
    commands: dict[str, tuple[Any, Callable[[Any], None]]] = {
        "raster": (Raster, _raster),
        "frame": (Frame, _frame),
        "grid": (Grid, _grid),
        "peers": (Peers, _peers),
        "shards": (Shards, _shards),
    }
    kinds = {name: kind for name, (kind, _) in commands.items()}
    options = tyro.extras.subcommand_cli_from_dict(kinds, prog="rnd-bench")
    run = next(run for kind, run in commands.values() if isinstance(options, kind))
    sys.exit(run_command("rnd-bench", lambda: run(options)))


def _raster(options: Raster) -> None:
    _prepare(options, "n", "size", "repeats")
    from rich.console import Console
    from rich.table import Table

    from .bench_raster import bench_raster

    rows = bench_raster(options.n, options.size, options.repeats, options.threads)
    table = Table(
        "kernel", "pass", "ms median", "ms p95", "PSNR dB", "gradient rel. L2",
        title=f"{options.n} Gaussians, {options.size}²",
    )  # fmt: skip
    for row in rows:
        gradient = row["grad_rel_l2"]
        table.add_row(
            row["kernel"], row["pass"], f"{row['ms_median']:.2f}", f"{row['ms_p95']:.2f}", f"{row['psnr_db']:.1f}",
            "" if gradient is None else f"{gradient:.1e}",
        )  # fmt: skip
    Console().print(table)
    _write(options.json, rows)


def _frame(options: Frame) -> None:
    _prepare(options, "n", "size", "threads")
    from rich.console import Console

    from .bench_grid import Setting, measured

    setting = Setting(
        options.n, options.size, options.shade, options.encoder, options.window, options.precision,
        options.raster, options.threads,
    )  # fmt: skip
    row = measured(setting, _inputs(options.files), seconds=6.0, compare=options.compare)
    console = Console()
    console.print(_line(row))
    for name, milliseconds in row["stages"].items():
        console.print(f"  {name:16} {milliseconds:6.2f} ms")
    _write(options.json, row)


def _grid(options: Grid) -> None:
    _prepare(options)
    from rich.console import Console

    from .bench_chart import draw_chart
    from .bench_grid import grid

    console = Console()

    def show(row: dict[str, Any], new: bool) -> None:
        console.print(_line(row) + ("" if new else "  (kept)"), highlight=False)

    rows = grid(_inputs(options.files), options.json, quick=options.quick, on_row=show)
    draw_chart(rows, list(options.chart))
    console.print(f"{options.json}, {', '.join(map(str, options.chart))}")


def _peers(options: Peers) -> None:
    _prepare(options, "n", "size", "threads")
    from rich.console import Console
    from rich.table import Table

    from .bench_avatars import Encoders, exported
    from .bench_peers import Amounts, bench_peers, growth

    inputs = _inputs(options.files)
    checkpoint = inputs.source(options.n)[0]
    avatar = exported(checkpoint, Encoders(), inputs.work)
    rows = bench_peers(checkpoint, avatar, options.n, options.size, options.threads)
    table = Table("stage", "peer", "ms median", "ms p95")
    for row in rows:
        timed = "ms_median" in row
        cells = [f"{row[key]:.2f}" for key in ("ms_median", "ms_p95")] if timed else [str(row["failed"]), ""]
        table.add_row(str(row["stage"]), str(row["peer"]), *cells)
    slopes = growth(Amounts(), options.size, options.threads)
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

    from .bench_shards import bench_shards

    files = (options.avatar, options.motion, options.hdr)
    rows = list(bench_shards(*files, options.frames, options.size, options.cores))
    table = Table("processes", "threads", "seconds", "frames/s", "speed-up")
    for row in rows:
        cells = (f"{row['seconds']:.2f}", f"{row['fps']:.1f}", f"{row['speed_up']:.2f}")
        table.add_row(str(row["processes"]), str(row["threads"]), *cells)
    Console().print(table)
    _write(options.json, rows)


def _line(row: dict[str, Any]) -> str:
    """A row in words."""
    window = "" if row["window"] is None else f" d={row['window']}"
    words = (
        f"{row['n']:6} {row['size']:4}² {row['shade']:9} {row['encoder']}{window} {row['precision']} {row['raster']} "
        f"{row['threads']} threads: "
    )
    if "failed" in row:
        return words + row["failed"]
    words += f"{row['ms_median']:.1f} ms (p95 {row['ms_p95']:.1f}), "
    words += f"{row['peak_mb']:.0f} MB, file {row['file_mb']:.1f} MB"
    if "psnr_db" in row:
        words += f", {row['psnr_db']:.1f} dB (worst {row['psnr_db_worst']:.1f})"
    return words


def _prepare(options: Any, *counts: str) -> None:
    from .eval_cli import need_extra

    need_extra()
    for name in counts:
        if getattr(options, name) < 1:
            raise InputError(f"--{name}", expected="at least 1", got=getattr(options, name))


def _inputs(files: Files) -> Any:
    from .bench_grid import Inputs

    return Inputs(files.body, files.motion, files.hdr, files.work, files.checkpoint).checked()


def _write(file: Path | None, value: Any) -> None:
    if file is not None:
        with atomic_path(file) as temporary:
            temporary.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
