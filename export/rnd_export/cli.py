"""rnd-export avatar.ckpt → avatar.onnx."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.errors import InputError, run_command


@dataclass(frozen=True)
class Options:
    """Freeze a trained avatar to one ONNX file that plays without torch."""

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """avatar.ckpt of rnd-train"""
    out: Path | None = None
    """where to write; by default avatar.onnx beside the checkpoint"""
    motion: Path | None = None
    """check against torch on this motion instead of 120 random frames"""


def main() -> None:
    """Entry point of ``rnd-export``."""
    options = tyro.cli(Options, prog="rnd-export")
    sys.exit(run_command("rnd-export", lambda: _export(options)))


def _export(options: Options) -> None:
    try:
        from .export import MAX_POSITION_ERROR_M, MAX_WEIGHT_ERROR, export
    except ModuleNotFoundError as error:
        raise InputError(
            f"{error.name} is not installed",
            hint='needs the extra: pip install "rnd-avatar[export]", in a clone ".[export]"',
        ) from error
    from rnd_runtime.motion import load_motion
    from rnd_trainer.checkpoint import load_checkpoint

    out = options.out or options.checkpoint.with_suffix(".onnx")
    motion = None
    if options.motion is not None:
        motion = load_motion(options.motion, load_checkpoint(options.checkpoint).skeleton)
    drift = export(options.checkpoint, out, motion)
    print(  # noqa: T201
        f"{out}: {out.stat().st_size / 1e6:.2f} MB; against torch over {drift.frames} frames: "
        f"weights {drift.weights:.1e} (at most {MAX_WEIGHT_ERROR:g}), "
        f"positions {1e3 * drift.position_m:.4f} mm (at most {1e3 * MAX_POSITION_ERROR_M:g}), "
        f"normals {drift.normal:.1e}, visibility {drift.visibility:.1e}"
    )
