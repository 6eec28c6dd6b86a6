"""rnd-bench: time and error of the same calls, as JSON rows."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rnd_runtime.errors import InputError, run_command
from rnd_runtime.files import atomic_path


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


def main() -> None:
    """Entry point of ``rnd-bench``."""
    options = tyro.extras.subcommand_cli_from_dict({"raster": Raster}, prog="rnd-bench")
    sys.exit(run_command("rnd-bench", lambda: _raster(options)))


def _raster(options: Raster) -> None:
    from .eval_cli import need_extra

    need_extra()
    from rich.console import Console
    from rich.table import Table

    from .bench_raster import bench_raster

    for name, least in (("n", 1), ("size", 1), ("repeats", 1)):
        if getattr(options, name) < least:
            raise InputError(f"--{name}", expected=f"at least {least}", got=getattr(options, name))
    rows = bench_raster(options.n, options.size, options.repeats, options.threads)
    table = Table(
        "kernel", "pass", "ms median", "ms p95", "PSNR dB", "gradient rel. L2", title=_title(options)
    )
    for row in rows:
        gradient = row["grad_rel_l2"]
        table.add_row(
            row["kernel"], row["pass"], f"{row['ms_median']:.2f}", f"{row['ms_p95']:.2f}", f"{row['psnr_db']:.1f}",
            "" if gradient is None else f"{gradient:.1e}",
        )  # fmt: skip
    Console().print(table)
    if options.json is not None:
        with atomic_path(options.json) as temporary:
            temporary.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _title(options: Raster) -> str:
    return f"{options.n} Gaussians, {options.size}²"
