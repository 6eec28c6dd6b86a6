"""rnd-export avatar.ckpt → avatar.onnx."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.avatar.file import EncoderKind, Precision
from rnd_runtime.core.errors import (
    InputError,
    check_cull,
    check_option,
    flag,
    parse_options,
    refuse_changed,
    run_command,
)
from rnd_runtime.shading.light import Up


@dataclass(frozen=True)
class Options:
    """Freeze a trained avatar to one ONNX file that plays without torch."""

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """avatar.ckpt of rnd-train, or the folder that it is in"""
    out: Path | None = None
    """where to write; by default avatar.onnx beside the checkpoint"""
    target: Literal["rnd", "visionary"] = "rnd"
    """visionary: not an avatar but a clip for Visionary's WebGPU renderer, with --motion and a light baked in"""
    motion: Path | None = None
    """check against torch on this motion instead of random frames, on 1000 of its frames at most"""
    frames: int = 120
    """random frames of that check, up to 1000"""
    encoder: EncoderKind = "full"
    """networks at every node, at fewer (coarse), or the template's skinning weights (static)"""
    precision: Precision = "f32"
    """how constants are stored; by itself f16 must keep 99 % of all places within 1 mm, int8 within 3 mm"""
    nodes: int | None = None
    """nodes of --encoder coarse; by default a quarter of the checkpoint's"""
    skinning_nodes: int | None = None
    """of these, at how many the skinning network is evaluated; between them it is interpolated"""
    offset_nodes: int | None = None
    """the same of the pose offsets"""
    visibility_nodes: int | None = None
    """the same of the visibility"""
    window_poses: int | None = None
    """poses in the motion window; fewer span the same time"""
    visibility_degree: int = 3
    """of the visibility's spherical harmonics, 0 to 3"""
    cull: float | None = None
    """n·v below which players leave Gaussians out, -1 to draw all; by default what is found not to show, in views all
    around --motion or around random poses"""
    target_ms: float | None = None
    """find the file that looks best among those that take this long a frame on this machine"""
    min_psnr: float | None = None
    """find the fastest file whose pictures are this near (dB) to the whole avatar's"""
    max_mb: float | None = None
    """find the file that looks best among those of this size (1e6 bytes)"""
    size: int = 512
    """picture side of that search"""
    hdr: Path | None = None
    """light of that search, or of --target visionary; by default the one that was learned"""
    hdr_up: Up = "y"
    """which axis points up in the light's file"""
    capture: Path | None = None
    """search in the training views of this capture (a folder with capture.json) and test what is found in its other
    poses; by default in views all around --motion, or around random poses"""
    json: Path | None = None
    """add what that search found to the rows of this file, in place of an earlier one of the same bound"""


BOUNDS = {"ms": "target_ms", "psnr": "min_psnr", "mb": "max_mb"}
SEARCHES = ("size", "hdr", "hdr_up", "capture", "json")
"""options that say how a bound's search goes"""
CHOICES = (
    "encoder",
    "precision",
    "nodes",
    "skinning_nodes",
    "offset_nodes",
    "visibility_nodes",
    "window_poses",
    "visibility_degree",
)
"""options that say what a file leaves out, which a search finds by itself"""


def main() -> None:
    """Entry point of ``rnd-export``."""

    def command() -> None:
        _export(parse_options(lambda: tyro.cli(Options, prog="rnd-export")))

    sys.exit(run_command("rnd-export", command))


def _export(options: Options) -> None:
    try:
        from rnd_export.reduce.variant import Variant

        from .export import MOST_FRAMES, export, random_motion
    except ModuleNotFoundError as error:
        raise InputError(
            f"{error.name} is not installed",
            hint='needs the extra: pip install "rnd-avatar[export]", in a clone ".[export]"',
        ) from error
    from rnd_runtime.avatar.file import advice_of
    from rnd_runtime.capture.capture import capture_file
    from rnd_runtime.core.files import existing_file, output_file, refuse_input
    from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
    from rnd_runtime.motion.motion import load_motion
    from rnd_trainer.model.checkpoint import load_checkpoint
    from rnd_trainer.training.notes import say_notes

    check_option(2 <= options.frames <= MOST_FRAMES, "--frames", f"2 to {MOST_FRAMES}", options.frames)
    check_cull(options.cull)
    check_option(16 <= options.size <= 4096, "--size", "16 to 4096", options.size)
    bounds = {kind: getattr(options, name) for kind, name in BOUNDS.items()}
    given = {kind: value for kind, value in bounds.items() if value is not None}
    _refuse_idle(options, bounded=bool(given))
    if options.checkpoint.is_dir():
        options = dataclasses.replace(options, checkpoint=options.checkpoint / "avatar.ckpt")
    file = existing_file(options.checkpoint, what="checkpoint")
    if options.out is None and file.suffix == ".onnx":
        raise InputError("not a checkpoint", expected="an avatar.ckpt of rnd-train", got=".onnx", file=file)
    out = options.out or file.with_suffix(".visionary.onnx" if options.target == "visionary" else ".onnx")
    captured = options.capture and capture_file(options.capture)
    for written in filter(None, (out, options.json)):
        refuse_input(written, file, options.motion, options.hdr, captured)
    refuse_input(out, options.json)  # rows are added to it
    check_option(out.suffix.lower() == ".onnx", "--out", "a name in .onnx", out)  # others are text to onnx
    for written in filter(None, (out, options.json)):
        output_file(written)
    checkpoint = load_checkpoint(file)
    if note := checkpoint.note():
        print(f"rnd-export: {note}", file=sys.stderr)  # noqa: T201
    if kernels_are_cold():
        print(f"rnd-export: {COMPILING}", file=sys.stderr, flush=True)  # noqa: T201
    if options.motion is not None:
        motion = load_motion(options.motion, checkpoint.skeleton)
        say_notes("rnd-export", motion.notes)
    else:
        motion = random_motion(checkpoint.skeleton, frames=options.frames, seed=0)
    if given:
        from rnd_export.search.bounded import export_bounded

        export_bounded(options, checkpoint, out, motion, given)
        return
    variant = Variant(**{name: getattr(options, name) for name in CHOICES})
    if options.target == "visionary":
        from .visionary import export_visionary

        assert options.motion is not None
        light = options.hdr, options.hdr_up
        for line in export_visionary(checkpoint, out, motion, options.motion, variant, *light):
            print(line)  # noqa: T201
        return
    drift = export(checkpoint, out, motion, variant, cull=options.cull)
    cull = advice_of(out).cull
    print(  # noqa: T201
        f"{out}: {out.stat().st_size / 1e6:.2f} MB; against torch over {drift.frames} frames: "
        f"weights {drift.weights:.1e}, positions {1e3 * drift.position_m:.4f} mm, "
        f"99 % within {1e3 * drift.position_p99_m:.4f} mm, "
        f"normals {drift.normal:.1e}, visibility {drift.visibility:.1e}; "
        + ("players draw all of it" if cull is None else f"players leave out what faces away (n·v < {cull:g})")
    )


def _refuse_idle(options: Options, *, bounded: bool) -> None:
    """Raise ``InputError`` for an option that was changed and would do nothing beside the others."""
    bounds = " or ".join(map(flag, BOUNDS.values()))
    if bounded:
        refuse_changed(options, (*CHOICES, "cull"), "a bound finds this by itself")
        refuse_changed(options, ("target",), "a bound is for avatars")
    elif options.target == "visionary":
        check_option(options.motion is not None, "--target visionary", "a --motion to bake in", "none")
        refuse_changed(options, ("cull",), "is for avatars: a clip shows all of its Gaussians")
        refuse_changed(options, [name for name in SEARCHES if not name.startswith("hdr")], f"needs {bounds}")
    else:
        refuse_changed(options, SEARCHES, f"needs {bounds}")
    if options.hdr is None:
        refuse_changed(options, ("hdr_up",), "needs --hdr")
    if options.motion is not None:
        refuse_changed(options, ("frames",), "of random motion: --motion has frames of its own")
    if options.capture is not None:
        refuse_changed(options, ("motion", "frames"), "--capture has a motion of its own")
