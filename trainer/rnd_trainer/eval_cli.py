"""rnd-eval: what a trained avatar is worth on pictures it was not trained on."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rnd_runtime.errors import InputError, run_command
from rnd_runtime.files import atomic_path

if TYPE_CHECKING:
    from torch import Tensor

    from rnd_runtime.capture_format import Split


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
    """folder for strips: truth, render, normals, albedo"""
    perceptual_weights: Path | None = None
    """AlexNet, SqueezeNet or VGG16 with LPIPS heads (.safetensors or .pth): adds the LPIPS column"""
    shade: str = "table+sun"
    """shading of rnd-play: ao, table, table+sun, lights:K or brute"""


def main() -> None:
    """Entry point of ``rnd-eval``."""
    options = tyro.cli(EvalOptions, prog="rnd-eval")
    sys.exit(run_command("rnd-eval", lambda: evaluate_run(options)))


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
    from rich.console import Console
    from rich.table import Table

    from rnd_runtime.capture import load_capture
    from rnd_runtime.images import write_image

    from .checkpoint import load_checkpoint
    from .evaluate import HELD_OUT, albedo_scale, evaluate
    from .perceptual import load_perceptual
    from .preview import strip

    path = options.run / "avatar.ckpt" if options.run.is_dir() else options.run
    checkpoint = load_checkpoint(path)
    capture = load_capture(options.capture)
    scale = albedo_scale(checkpoint, capture)
    jobs: list[tuple[Split, Tensor | None]] = [(split, None) for split in HELD_OUT if capture.split(split)]
    if scale is not None and capture.split("relight"):
        jobs.append(("relight", scale))
    if not jobs:
        raise InputError("held-out splits", expected=" or ".join(HELD_OUT), got="none", file=options.capture)

    perceptual = None if options.perceptual_weights is None else load_perceptual(options.perceptual_weights)
    if perceptual is not None and not perceptual.is_lpips:
        raise InputError(
            "--perceptual-weights", expected="a whole network with LPIPS heads", got=perceptual.backbone,
            file=options.perceptual_weights,
        )  # fmt: skip
    columns = ["split", "frames", "PSNR", "SSIM", "PSNR box", "SSIM box", "normals °"]
    columns += [] if perceptual is None else [f"LPIPS ({perceptual.backbone})"]
    table = Table(*columns, title=str(path))
    rows = []
    for split, factor in jobs:
        name = split if factor is None else f"{split}, albedo scaled"

        def keep(
            frame: Any, rendered: Any, target: Any, folder: str = name.replace(", ", "_").replace(" ", "_")
        ) -> None:
            if options.pictures is not None:
                file = options.pictures / folder / Path(frame.image).name
                write_image(file, strip(rendered, target.numpy()))

        score = evaluate(
            checkpoint,
            capture,
            split,
            mode=options.shade,
            albedo_scale=factor,
            perceptual=perceptual,
            on_frame=keep,
        )
        row = {**dataclasses.asdict(score), "split": name, "shade": options.shade}
        row |= _provenance(checkpoint)
        row["lpips_weights_sha256"] = None if perceptual is None else perceptual.sha256
        rows.append(row)
        cells = [f"{score.psnr:.2f}", f"{score.ssim:.4f}", f"{score.psnr_box:.2f}", f"{score.ssim_box:.4f}"]
        cells += [f"{score.normal_deg:.1f}"] + ([] if score.lpips is None else [f"{score.lpips:.4f}"])
        table.add_row(name, str(score.frames), *cells)
    Console().print(table)
    if options.json is not None:
        with atomic_path(options.json) as temporary:
            temporary.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _provenance(checkpoint: Any) -> dict[str, Any]:
    from rnd_runtime.doctor import machine

    info, config = checkpoint.info, checkpoint.config
    return {
        "minutes": info.get("minutes"), "capture": info.get("capture"), "steps": config.steps, "seed": config.seed,
        "gaussians": config.model.gaussians, "image_scale": config.image_scale, "light": config.light,
        "machine": machine(),
    }  # fmt: skip
