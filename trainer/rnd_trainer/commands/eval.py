"""rnd-eval: scores of a trained avatar on held-out images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rnd_runtime.cli.command import Flag, OptionalFile, OptionalFolder, is_quiet, log, option, parse, run_command, warn
from rnd_runtime.core.errors import InputError, check_cull
from rnd_runtime.core.files import is_folder, output_file, output_folder, refuse_input, write_json

from .console import log_all, need_extra, wide_console

if TYPE_CHECKING:
    from rnd_trainer.model.checkpoint import Checkpoint

COLUMNS = {
    "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "psnr_person": ("PSNR person", "{:.2f}"),
    "psnr_box": ("PSNR box", "{:.2f}"),
    "ssim_box": ("SSIM box", "{:.4f}"),
    "lpips_box": ("LPIPS box", "{:.4f}"),
    "psnr_n": ("PSNR_n", "{:.2f}"),
    "ssim_n": ("SSIM_n", "{:.4f}"),
    "normal_deg": ("normals °", "{:.1f}"),
    "psnr_albedo": ("albedo", "{:.2f}"),
    "outline_px": ("outline px", "{:.2f}"),
}
"""columns of the table: heading and format"""
UNKNOWN = {
    "pictures": "--strips FOLDER writes them",
    "ablate": "rnd-bench study ablations trains them",
    "study": "rnd-bench study trains and scores variants",
    "hdr": "the capture names its lights",
    "light": "the capture names its lights",
}


@dataclass(frozen=True)
class EvalOptions:
    """Score a trained avatar on the held-out splits of a capture.

    rnd-eval runs/me captures/me --json scores.json
    """

    run: Annotated[tyro.conf.Positional[Path], option("RUN|CHECKPOINT")]
    """Folder of rnd-train, or an avatar.ckpt."""
    capture: Annotated[tyro.conf.Positional[Path], option("CAPTURE")]
    """Folder with capture.json."""
    json: OptionalFile = None
    """Write the rows here."""
    strips: OptionalFolder = None
    """Write strips here: truth, render, normals, albedo, error."""
    perceptual_weights: OptionalFile = None
    """AlexNet, SqueezeNet or VGG16 with LPIPS heads (.safetensors or .pth): adds LPIPS."""
    shade: Annotated[str, option("MODE")] = "table+sun"
    """Shading: ao, table, table+sun, lights:K or brute."""
    cull: Annotated[float | None, option("COSINE")] = None
    """n·v below which Gaussians are left out, such as -0.5. Default: none are."""
    motion: Annotated[str | None, option("FILE")] = None
    """Another motion file of the capture. Default: the poses refined in training, else the capture's own."""
    fit_poses: Flag = False
    """Fit the poses of novel_pose frames to their images first, the avatar frozen: for estimated poses."""
    method: Annotated[str | None, option("NAME")] = None
    """Name of the rows. Default: the run folder's."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``rnd-eval``."""
    return run_command("rnd-eval", lambda: evaluate_run(parse(EvalOptions, "rnd-eval", arguments, unknown=UNKNOWN)))


def evaluate_run(options: EvalOptions) -> None:
    """Score all held-out splits of the capture; print a table, write rows and strips."""
    need_extra()
    from rich.markup import escape
    from rich.table import Table

    from rnd_runtime.capture.capture import load_capture
    from rnd_runtime.shading.shader import check_mode
    from rnd_trainer.evaluation.evaluate import scored_splits
    from rnd_trainer.evaluation.held_out import score
    from rnd_trainer.losses.perceptual import load_lpips
    from rnd_trainer.model.checkpoint import load_checkpoint
    from rnd_trainer.training.notes import capture_notes

    check_mode(options.shade)
    check_cull(options.cull)
    check_outputs(options)
    path = _checkpoint_file(options)
    checkpoint = load_checkpoint(path)
    if note := checkpoint.note():
        warn(note)
    capture = load_capture(options.capture, motion_file=options.motion or _refined_motion(path, checkpoint, options))
    log_all(capture_notes(capture, scored_splits(checkpoint.config)))
    if options.fit_poses:
        from rnd_runtime.cli.progress import Progress
        from rnd_trainer.evaluation.held_out_poses import fit_held_out

        with Progress() as progress:
            progress.phase("fitting held-out poses")
            fitted = fit_held_out(checkpoint, capture, on_frame=lambda done, total: progress.update(done))
        capture = replace(capture, motion=fitted)
    exported = path.with_suffix(".onnx")
    rows = score(
        checkpoint,
        capture,
        method=options.method or path.resolve().parent.name,
        mode=options.shade,
        strips=options.strips,
        perceptual=load_lpips(options.perceptual_weights),
        avatar=exported if _is_of(exported, checkpoint.sha256) else None,
        cull=options.cull,
    )
    if options.json is not None:
        write_json(options.json, rows)
    if is_quiet():
        return
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
    """Raise ``InputError`` for outputs that cannot be written or are inputs."""
    from rnd_runtime.capture.capture import capture_file

    checkpoint = _checkpoint_file(options)
    read = (checkpoint, checkpoint.with_suffix(".onnx"), capture_file(options.capture))
    if options.json is not None:
        refuse_input(options.json, *read, options.perceptual_weights)
        output_file(options.json)
    if options.strips is not None:
        output_folder(options.strips)


def _checkpoint_file(options: EvalOptions) -> Path:
    return options.run / "avatar.ckpt" if is_folder(options.run) else options.run


def _refined_motion(path: Path, checkpoint: Checkpoint, options: EvalOptions) -> str | None:
    """The motion refined in training on this capture, or None; logs it."""
    from rnd_runtime.capture.capture import capture_file
    from rnd_trainer.training.saving import REFINED_MOTION

    file = path.with_name(REFINED_MOTION).resolve()
    capture = capture_file(options.capture)
    if not (checkpoint.config.refine_poses and file.is_file() and capture.is_file()):
        return None
    if not checkpoint.learned_from(capture):
        return None
    log(f"poses of {file}, refined in training; --motion takes others")
    return str(file)


def _is_of(exported: Path, checkpoint_sha256: str) -> bool:
    """Whether ``exported`` exists and is of this checkpoint; warns if it is of another."""
    from rnd_runtime.avatar.file import metadata_of

    if not exported.is_file():
        return False
    try:
        source_sha256 = metadata_of(exported).checkpoint_sha256
    except InputError as error:
        warn(f"{error}: its size and speed are left out")
        return False
    if source_sha256 == checkpoint_sha256:
        return True
    warn(f"{exported}: of another checkpoint: its size and speed are left out")
    return False
