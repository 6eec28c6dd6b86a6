"""rnd-eval: what a trained avatar is worth on pictures it was not trained on."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rnd_runtime.core.command import parse_options, run_command
from rnd_runtime.core.errors import InputError, check_cull
from rnd_runtime.core.files import is_folder, output_file, output_folder, refuse_input, write_json

if TYPE_CHECKING:
    from rich.console import Console

    from rnd_trainer.model.checkpoint import Checkpoint

COLUMNS = {
    "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "psnr_box": ("PSNR box", "{:.2f}"),
    "ssim_box": ("SSIM box", "{:.4f}"),
    "lpips_box": ("LPIPS box", "{:.4f}"),
    "psnr_n": ("PSNR_n", "{:.2f}"),
    "ssim_n": ("SSIM_n", "{:.4f}"),
    "normal_deg": ("normals °", "{:.1f}"),
    "psnr_albedo": ("albedo", "{:.2f}"),
    "outline_px": ("outline px", "{:.2f}"),
}
"""what the terminal's table shows of a row: heading and format"""
WIDTH = 140
"""characters of the widest table"""


@dataclass(frozen=True)
class EvalOptions:
    """Score a trained avatar on the held-out splits of a capture."""

    run: Annotated[Path, tyro.conf.Positional]
    """folder of rnd-train, or an avatar.ckpt"""
    capture: Annotated[Path, tyro.conf.Positional]
    """folder with capture.json"""
    json: Path | None = None
    """write the rows here as JSON"""
    pictures: Path | None = None
    """folder for strips: truth, render, normals, albedo, error"""
    perceptual_weights: Path | None = None
    """AlexNet, SqueezeNet or VGG16 with LPIPS heads (.safetensors or .pth): adds the LPIPS column"""
    shade: str = "table+sun"
    """shading of rnd-play: ao, table, table+sun, lights:K or brute"""
    cull: float | None = None
    """as of rnd-play: leave out what faces away, Gaussians whose n·v is below this cosine (−1 to 1), such as -0.5"""
    motion: str | None = None
    """another motion file of the capture to render with: exact poses for an avatar trained on noisy ones. Default: the
    poses that the training corrected (--refine-poses), else the capture's own."""
    method: str | None = None
    """name of the rows in the JSON; the run folder's unless given"""


def main() -> None:
    """Entry point of ``rnd-eval``."""

    def command() -> None:
        options = parse_options(lambda: tyro.cli(EvalOptions, prog="rnd-eval"))
        evaluate_run(options)

    sys.exit(run_command("rnd-eval", command))


def need_extra() -> None:
    """Refuse to go on, naming the extra to install, where torch and its company are missing."""
    for package in ("torch", "safetensors", "scipy"):
        if importlib.util.find_spec(package) is None:
            raise InputError(
                f"{package} is not installed",
                hint='needs the extra: pip install "rnd-avatar[train]", in a clone ".[train]"',
            )


def evaluate_run(options: EvalOptions) -> None:
    """Score every held-out split that the capture has; print a table, write rows and pictures as asked."""
    need_extra()
    from rich.markup import escape
    from rich.table import Table

    from rnd_runtime.capture.capture import load_capture
    from rnd_runtime.shading.shader import check_mode
    from rnd_trainer.evaluation.evaluate import HELD_OUT
    from rnd_trainer.evaluation.held_out import score
    from rnd_trainer.losses.perceptual import load_lpips
    from rnd_trainer.model.checkpoint import load_checkpoint
    from rnd_trainer.training.notes import capture_notes, say_notes

    check_mode(options.shade)
    check_cull(options.cull)
    check_outputs(options)
    path = _checkpoint_file(options)
    checkpoint = load_checkpoint(path)
    if note := checkpoint.note():
        print(f"rnd-eval: {note}", file=sys.stderr)  # noqa: T201
    capture = load_capture(options.capture, motion_file=options.motion or _corrected(path, checkpoint, options))
    say_notes("rnd-eval", capture_notes(capture, HELD_OUT))
    exported = path.with_suffix(".onnx")
    rows = score(
        checkpoint,
        capture,
        method=options.method or path.resolve().parent.name,
        mode=options.shade,
        pictures=options.pictures,
        perceptual=load_lpips(options.perceptual_weights),
        avatar=exported if _is_of(exported, checkpoint.sha256) else None,
        cull=options.cull,
    )
    if options.json is not None:
        write_json(options.json, rows)
    names = [name for name in COLUMNS if any(name in row for row in rows)]
    table = Table("split", "frames", *(COLUMNS[name][0] for name in names), title=escape(str(path)))
    for row in rows:
        cells = [COLUMNS[name][1].format(row[name]) if name in row else "" for name in names]
        table.add_row(row["split"], str(row["frames"]), *cells)
    console = wide_console()
    console.print(table)
    if rows[0].get("flicker") is not None:
        console.print(f"flicker on the held-out motion: {rows[0]['flicker']:.2f} of 255 levels")
    if "fps" in rows[0]:
        line = f"{exported.name}: {rows[0]['file_mb']:.1f} MB, {rows[0]['fps']:.0f} frames a second"
        console.print(line, markup=False, emoji=False)


def check_outputs(options: EvalOptions) -> None:
    """Raise ``InputError`` for what could not be written once everything is scored, or is read before."""
    from rnd_runtime.capture.capture import capture_file

    checkpoint = _checkpoint_file(options)
    read = (checkpoint, checkpoint.with_suffix(".onnx"), capture_file(options.capture))
    for file in filter(None, (options.json,)):
        refuse_input(file, *read, options.perceptual_weights)
        output_file(file)
    if options.pictures is not None:
        output_folder(options.pictures)


def _checkpoint_file(options: EvalOptions) -> Path:
    return options.run / "avatar.ckpt" if is_folder(options.run) else options.run


def _corrected(path: Path, checkpoint: Checkpoint, options: EvalOptions) -> str | None:
    """The poses that the training corrected, where it did and on this capture; says so."""
    from rnd_runtime.capture.capture import capture_file
    from rnd_trainer.training.training import REFINED_MOTION

    file = path.with_name(REFINED_MOTION).resolve()
    capture = capture_file(options.capture)
    if not (checkpoint.config.refine_poses and file.is_file() and capture.is_file()):
        return None
    if not checkpoint.learned_from(capture):
        return None
    print(f"rnd-eval: poses of {file}, corrected in training; --motion takes others", file=sys.stderr)  # noqa: T201
    return str(file)


def _is_of(exported: Path, checkpoint_sha256: str) -> bool:
    """Whether ``exported`` is there and was made of that checkpoint; says where only the first holds."""
    from rnd_runtime.avatar.file import metadata_of

    if not exported.is_file():
        return False
    try:
        made_of = metadata_of(exported).checkpoint_sha256
    except InputError as error:
        print(f"{error}: its size and speed are left out", file=sys.stderr)  # noqa: T201
        return False
    if made_of == checkpoint_sha256:
        return True
    print(f"{exported}: of another checkpoint: its size and speed are left out", file=sys.stderr)  # noqa: T201
    return False


def wide_console() -> Console:
    """Where a terminal is too narrow, lines go on in the next: figures cut to two digits tell nothing."""
    from rich.console import Console

    return Console(width=max(Console().width, WIDTH), soft_wrap=True)
