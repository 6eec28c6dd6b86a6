"""rnd-export avatar.ckpt → avatar.onnx."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.avatar.file import EncoderKind, Precision
from rnd_runtime.cli.command import (
    MAX_SIDE,
    Count,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalNumber,
    Size,
    finish,
    group,
    log,
    option,
    parse,
    run_command,
    show,
    size_text,
)
from rnd_runtime.cli.extras import need_packages
from rnd_runtime.cli.lock import file_lock
from rnd_runtime.core.errors import InputError, check_cull, check_option, flag, refuse_changed
from rnd_runtime.shading.light import Up

BOUNDS = {"ms": "target_ms", "psnr": "min_psnr", "mb": "max_mb"}  # options of the search, by kind of bound
MIN_SIDE = 16
UNKNOWN = {"light": "the light probe of the search is --hdr FILE", "target": "rnd-convert splats writes clips"}


@dataclass(frozen=True)
class Reduction:
    """What the file leaves out."""

    encoder: EncoderKind = "full"
    """Networks at every node, at a quarter of them (coarse), or the template's skinning weights (static)."""
    precision: Precision = "f32"
    """Of stored constants; f16 must keep 99 % of all positions within 1 mm, int8 within 3 mm."""
    window_poses: OptionalCount = None
    """Poses in the motion window; fewer span the same time."""


@dataclass(frozen=True)
class Search:
    """A bound, by which the reduction is searched on this machine."""

    target_ms: OptionalNumber = None
    """The best-looking file that takes at most this many milliseconds per frame."""
    min_psnr: OptionalNumber = None
    """The fastest file whose images are within this PSNR (dB) of the whole avatar's."""
    max_mb: OptionalNumber = None
    """The best-looking file of at most this size (1e6 bytes)."""
    size: Size = (512, None)
    """Image size of the search, in pixels."""
    hdr: OptionalFile = None
    """Light probe of the search. Default: the learned light."""
    hdr_up: Up = "y"
    """Which axis points up in the light probe."""
    capture: OptionalFolder = None
    """Search in this capture's training views, test in its other poses. Default: views all around the motion."""
    json: OptionalFile = None
    """Add the result to the rows of this file."""


@dataclass(frozen=True)
class Options:
    """Freeze a trained avatar to one ONNX file that plays without torch.

    rnd-export runs/me/avatar.ckpt --max-mb 3
    """

    checkpoint: Annotated[Path, option("CHECKPOINT"), tyro.conf.Positional]
    """avatar.ckpt of rnd-train, or its folder."""
    out: OptionalFile = None
    """The .onnx to write. Default: avatar.onnx beside the checkpoint."""
    motion: OptionalFile = None
    """Compare with torch on this motion (at most 1000 of its frames) instead of random poses."""
    frames: Count = 120
    """Random frames to compare on, up to 1000."""
    cull: Annotated[float | None, option("COSINE")] = None
    """n·v below which players leave Gaussians out, -1 for none. Default: what does not show."""
    reduction: Annotated[Reduction, *group("reduction")] = field(default_factory=Reduction)
    search: Annotated[Search, *group("search")] = field(default_factory=Search)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``rnd-export``."""
    return run_command("rnd-export", lambda: _export(parse(Options, "rnd-export", arguments, unknown=UNKNOWN)))


def _export(options: Options) -> None:
    need_packages("export", "torch", "cv2", "trimesh", "scipy", "safetensors", "onnx", "onnxscript")
    from rnd_export.reduce.variant import Variant
    from rnd_export.search.bounded import BoundedSearch, export_bounded
    from rnd_export.search.budget import Bound
    from rnd_runtime.avatar.file import advice_of
    from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
    from rnd_runtime.motion.motion import load_motion
    from rnd_trainer.model.checkpoint import load_checkpoint

    from .export import export
    from .parity import MAX_FRAMES, random_motion

    check_option(2 <= options.frames <= MAX_FRAMES, "--frames", f"2 to {MAX_FRAMES}", options.frames)
    search = dataclasses.asdict(options.search)
    bounds = {kind: value for kind, name in BOUNDS.items() if (value := search.pop(name)) is not None}
    _check(options, bounds)
    if options.checkpoint.is_dir():
        options = dataclasses.replace(options, checkpoint=options.checkpoint / "avatar.ckpt")
    file, out = _files(options)
    checkpoint = load_checkpoint(file)
    _log_all(filter(None, [checkpoint.note(), COMPILING if kernels_are_cold() else None]))
    if options.motion is not None:
        motion = load_motion(options.motion, checkpoint.skeleton)
        _log_all(motion.notes)
    else:
        motion = random_motion(checkpoint.skeleton, frames=options.frames, seed=0)
    play = f"rnd-play {out} --motion FILE --out FOLDER"
    with file_lock(out, "rnd-export"):
        if bounds:
            ((kind, value),) = bounds.items()
            what = BoundedSearch(Bound(kind, value), flag(BOUNDS[kind]), motion, **search)  # type: ignore[arg-type]
            finish(out, export_bounded(checkpoint, out, what, show=show, warn=_log_all), then=play)
            return
        parity = export(checkpoint, out, motion, Variant(**dataclasses.asdict(options.reduction)), cull=options.cull)
    cull = advice_of(out).cull
    summary = (
        f"{out.stat().st_size / 1e6:.2f} MB; against torch over {parity.frames} frames: "
        f"weights {parity.weights:.1e}, positions {1e3 * parity.position_m:.4f} mm, "
        f"99 % within {1e3 * parity.position_p99_m:.4f} mm, "
        f"normals {parity.normal:.1e}, visibility {parity.visibility:.1e}; "
        + ("players draw all of it" if cull is None else f"players leave out what faces away (n·v < {cull:g})")
    )
    finish(out, summary, then=play)


def _log_all(notes: Iterable[str]) -> None:
    for note in notes:
        log(note)


def _files(options: Options) -> tuple[Path, Path]:
    """The checkpoint, and the file to write, which differs from all inputs."""
    from rnd_runtime.capture.capture import capture_file
    from rnd_runtime.core.files import existing_file, output_file, refuse_input

    file, search = existing_file(options.checkpoint, what="checkpoint"), options.search
    if options.out is None and file.suffix == ".onnx":
        raise InputError("not a checkpoint", expected="an avatar.ckpt of rnd-train", got=".onnx", file=file)
    out = options.out or file.with_suffix(".onnx")
    captured = search.capture and capture_file(search.capture)
    for written in filter(None, (out, search.json)):
        refuse_input(written, file, options.motion, search.hdr, captured)
    refuse_input(out, search.json)  # rows are added to it
    check_option(out.suffix.lower() == ".onnx", "--out", "a name in .onnx", out)  # others are text to onnx
    for written in filter(None, (out, search.json)):
        output_file(written)
    return file, out


def _check(options: Options, bounds: dict[str, float]) -> None:
    """Refuse options outside their range or without effect."""
    check_cull(options.cull)
    search, reduction = options.search, options.reduction
    sides = [side for side in search.size if side is not None]
    check_option(min(sides) >= MIN_SIDE, "--size", f"{MIN_SIDE} to {MAX_SIDE}", min(sides))
    for kind, value in bounds.items():
        check_option(value > 0, flag(BOUNDS[kind]), "more than 0", value)
    names = " or ".join(map(flag, BOUNDS.values()))
    check_option(len(bounds) <= 1, "bounds", f"one of {names}", len(bounds))
    if bounds:
        hint = "a bound finds this by itself"
        refuse_changed(reduction, [each.name for each in dataclasses.fields(Reduction)], hint)
        refuse_changed(options, ("cull",), hint)
    else:
        if search.size != Search.size:
            raise InputError("--size", expected="the default", got=size_text(search.size), hint=f"needs {names}")
        refuse_changed(search, ("hdr", "hdr_up", "capture", "json"), f"needs {names}")
    if search.hdr is None:
        refuse_changed(search, ("hdr_up",), "needs --hdr")
    if options.motion is not None:
        refuse_changed(options, ("frames",), "of random motion: --motion has frames of its own")
    if search.capture is not None:
        refuse_changed(options, ("motion", "frames"), "--capture has a motion of its own")
