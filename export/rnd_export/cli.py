"""rnd-export avatar.ckpt → avatar.onnx."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.avatar.file import EncoderKind, Precision
from rnd_runtime.core.command import parse_options, run_command
from rnd_runtime.core.errors import InputError, check_cull, check_option, flag, refuse_changed
from rnd_runtime.shading.light import Up

BOUNDS = ("target_ms", "min_psnr", "max_mb")
SEARCH_OPTIONS = ("size", "hdr", "hdr_up", "capture", "json")
VARIANT_OPTIONS = ("encoder", "precision", "skinning_nodes", "offset_nodes", "window_poses")


@dataclass(frozen=True)
class Options:
    """Freeze a trained avatar to one ONNX file that plays without torch."""

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """avatar.ckpt of rnd-train, or its folder"""
    out: Path | None = None
    """the .onnx to write; by default avatar.onnx beside the checkpoint"""
    motion: Path | None = None
    """compare with torch on this motion (at most 1000 of its frames) instead of random frames"""
    frames: int = 120
    """random frames to compare on, up to 1000"""
    encoder: EncoderKind = "full"
    """networks at every node, at a quarter of them (coarse), or the template's skinning weights (static)"""
    precision: Precision = "f32"
    """of stored constants; f16 must keep 99 % of all positions within 1 mm, int8 within 3 mm"""
    skinning_nodes: int | None = None
    """nodes at which the skinning network is evaluated; the others interpolate"""
    offset_nodes: int | None = None
    """the same for the pose offsets"""
    window_poses: int | None = None
    """poses in the motion window; fewer span the same time"""
    cull: float | None = None
    """n·v below which players leave Gaussians out, -1 to draw all; by default measured"""
    target_ms: float | None = None
    """search for the best-looking file that takes this long per frame on this machine"""
    min_psnr: float | None = None
    """search for the fastest file whose images are within this PSNR (dB) of the whole avatar's"""
    max_mb: float | None = None
    """search for the best-looking file of this size (1e6 bytes)"""
    size: int = 512
    """image side of the search"""
    hdr: Path | None = None
    """light probe of the search; by default the learned light"""
    hdr_up: Up = "y"
    """which axis points up in the light probe"""
    capture: Path | None = None
    """search in this capture's training views and test in its other poses; by default in views all around the motion"""
    json: Path | None = None
    """add the search's result to the rows of this file"""


def main() -> None:
    """Entry point of ``rnd-export``."""

    def command() -> None:
        _export(parse_options(lambda: tyro.cli(Options, prog="rnd-export")))

    sys.exit(run_command("rnd-export", command))


def _export(options: Options) -> None:
    try:
        from rnd_export.reduce.variant import Variant
        from rnd_export.search.bounded import BoundedSearch, export_bounded
        from rnd_export.search.budget import OPTIONS, Bound

        from .export import export
        from .parity import MAX_FRAMES, random_motion
    except ModuleNotFoundError as error:
        raise InputError(
            f"{error.name} is not installed",
            hint='needs the extra: pip install "rnd-avatar[export]", in a clone ".[export]"',
        ) from error
    from rnd_runtime.avatar.file import advice_of
    from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
    from rnd_runtime.motion.motion import load_motion
    from rnd_trainer.model.checkpoint import load_checkpoint
    from rnd_trainer.training.notes import say_notes

    check_option(2 <= options.frames <= MAX_FRAMES, "--frames", f"2 to {MAX_FRAMES}", options.frames)
    bounds = {kind: getattr(options, name) for kind, name in OPTIONS.items() if getattr(options, name) is not None}
    _check(options, len(bounds))
    if options.checkpoint.is_dir():
        options = dataclasses.replace(options, checkpoint=options.checkpoint / "avatar.ckpt")
    file, out = _files(options)
    checkpoint = load_checkpoint(file)
    say_notes("rnd-export", filter(None, [checkpoint.note(), COMPILING if kernels_are_cold() else None]))
    if options.motion is not None:
        motion = load_motion(options.motion, checkpoint.skeleton)
        say_notes("rnd-export", motion.notes)
    else:
        motion = random_motion(checkpoint.skeleton, frames=options.frames, seed=0)
    for kind, value in bounds.items():
        settings = {name: getattr(options, name) for name in SEARCH_OPTIONS}
        what = BoundedSearch(Bound(kind, value), motion, **settings)  # type: ignore[arg-type]
        export_bounded(checkpoint, out, what, show=_show, warn=lambda notes: say_notes("rnd-export", notes))
        return
    error = export(
        checkpoint,
        out,
        motion,
        Variant(**{name: getattr(options, name) for name in VARIANT_OPTIONS}),
        cull=options.cull,
    )
    cull = advice_of(out).cull
    _show(
        f"{out}: {out.stat().st_size / 1e6:.2f} MB; against torch over {error.frames} frames: "
        f"weights {error.weights:.1e}, positions {1e3 * error.position_m:.4f} mm, "
        f"99 % within {1e3 * error.position_p99_m:.4f} mm, "
        f"normals {error.normal:.1e}, visibility {error.visibility:.1e}; "
        + ("players draw all of it" if cull is None else f"players leave out what faces away (n·v < {cull:g})")
    )


def _show(line: str) -> None:
    print(line, flush=True)  # noqa: T201


def _files(options: Options) -> tuple[Path, Path]:
    """The checkpoint and the file to write, which is none of those that are read."""
    from rnd_runtime.capture.capture import capture_file
    from rnd_runtime.core.files import existing_file, output_file, refuse_input

    file = existing_file(options.checkpoint, what="checkpoint")
    if options.out is None and file.suffix == ".onnx":
        raise InputError("not a checkpoint", expected="an avatar.ckpt of rnd-train", got=".onnx", file=file)
    out = options.out or file.with_suffix(".onnx")
    captured = options.capture and capture_file(options.capture)
    for written in filter(None, (out, options.json)):
        refuse_input(written, file, options.motion, options.hdr, captured)
    refuse_input(out, options.json)  # rows are added to it
    check_option(out.suffix.lower() == ".onnx", "--out", "a name in .onnx", out)  # others are text to onnx
    for written in filter(None, (out, options.json)):
        output_file(written)
    return file, out


def _check(options: Options, bounds: int) -> None:
    """Raise ``InputError`` for options outside their range, or without effect beside the others."""
    check_cull(options.cull)
    check_option(16 <= options.size <= 4096, "--size", "16 to 4096", options.size)
    for name in BOUNDS:
        value = getattr(options, name)
        check_option(value is None or value > 0, flag(name), "more than 0", value)
    check_option(bounds <= 1, "bounds", f"one of {', '.join(map(flag, BOUNDS))}", bounds)
    if bounds:
        refuse_changed(options, (*VARIANT_OPTIONS, "cull"), "a bound finds this by itself")
    else:
        refuse_changed(options, SEARCH_OPTIONS, f"needs {' or '.join(map(flag, BOUNDS))}")
    if options.hdr is None:
        refuse_changed(options, ("hdr_up",), "needs --hdr")
    if options.motion is not None:
        refuse_changed(options, ("frames",), "of random motion: --motion has frames of its own")
    if options.capture is not None:
        refuse_changed(options, ("motion", "frames"), "--capture has a motion of its own")
