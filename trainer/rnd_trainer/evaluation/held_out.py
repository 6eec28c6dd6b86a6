"""Scores of a trained avatar on the held-out splits of a capture, as rows for a table or a JSON file."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numba
from torch import Tensor

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of
from rnd_runtime.core.images import write_image
from rnd_runtime.playback.doctor import machine
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.shading.light import Light
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.model.checkpoint import Checkpoint

from .evaluate import Evaluator, albedo_scale, evaluate, flicker, scored_splits
from .preview import contact_sheet, strip

PLAYED = 40
"""frames of the playback timing"""


def score(
    checkpoint: Checkpoint,
    capture: Capture,
    *,
    method: str,
    mode: str = "table+sun",
    strips: Path | None = None,
    perceptual: Perceptual | None = None,
    avatar: Path | None = None,
    cull: float | None = None,
) -> list[dict[str, Any]]:
    """Score all held-out splits of the capture, relighting with and without scaled albedo.

    Args:
        method: name of the rows.
        mode: shading of the runtime.
        strips: folder for strips and a contact sheet per split.
        perceptual: network of LPIPS.
        avatar: exported file; adds its size and frame rate.
        cull: as of ``rnd_runtime.playback.frame.FrameRenderer``.

    Raises:
        InputError: the capture has no held-out split.
    """
    evaluator = Evaluator(checkpoint, capture, mode, cull=cull)
    capture, splits = evaluator.capture, scored_splits(checkpoint.config)
    lit = checkpoint.config.light != "none"  # otherwise there is no albedo
    scale = albedo_scale(evaluator) if lit else None
    jobs: list[tuple[Split, Tensor | None]] = [(split, None) for split in splits if capture.split(split)]
    if scale is not None and capture.split("relight"):
        jobs.append(("relight", scale))
    if not jobs:
        raise InputError("held-out splits", expected=" or ".join(splits), got="none", file=capture.folder)
    common = {
        "flicker": None if checkpoint.config.hold_out else flicker(evaluator),
        "albedo_scale": None if scale is None else [round(float(x), 4) for x in scale],
        "shade": mode,
        "cull": cull,
        "lpips_weights": None if perceptual is None else perceptual.backbone,
        "lpips_weights_sha256": None if perceptual is None else perceptual.sha256,
        **({} if avatar is None else playback(avatar, evaluator)),
        "size": sizes(capture, splits),
        "scored_on": capture.folder.resolve().name,
        "capture_sha256": sha256_of(capture.file),
        "motion": Path(evaluator.motion.source).name,
        **_provenance(checkpoint),
    }
    names = strip_names([frame.image for split, _ in jobs for frame in capture.split(split)])
    rows = []
    for split, factor in jobs:
        name = split if factor is None else f"{split}, albedo scaled"
        folder = None if strips is None else strips / name.replace(", ", "_").replace(" ", "_")
        shown: list[Any] = []

        def keep(frame: Any, rendered: Any, target: Any, folder: Path | None = folder, strips: Any = shown) -> None:
            if folder is not None:
                strips.append(strip(rendered, target.numpy()))
                write_image(folder / f"{names[frame.image]}.png", strips[-1])

        result = evaluate(
            evaluator, split, albedo_scale=factor, shown_scale=scale, perceptual=perceptual, on_frame=keep
        )
        if not lit:
            result.scores.pop("psnr_albedo", None)
        if folder is not None:
            contact_sheet(folder.with_name(f"{folder.name}.png"), shown)
        exact = all(frame.normal_gt is not None for frame in capture.split(split))
        rows.append(
            {
                "split": name,
                "method": method,
                "frames": result.frames,
                **result.scores,
                "normals": "exact" if exact else "estimated",
                **common,
            }
        )
    return rows


def strip_names(images: Iterable[str]) -> dict[str, str]:
    """Unique names for ``images``, paths in a capture: the stem, or with its folders if it is not unique."""
    paths = {image: PurePosixPath(image).with_suffix("") for image in images}
    stems = Counter(path.name for path in paths.values())
    return {image: path.name if stems[path.name] == 1 else "_".join(path.parts) for image, path in paths.items()}


def playback(avatar: Path, evaluator: Evaluator) -> dict[str, Any]:
    """Size in MB of an exported avatar, and its median frame rate in Hz from pose to pixels in memory.

    Under the learned light, for the first held-out camera, over ``PLAYED`` consecutive frames.
    """
    frame = next(
        frame for split in scored_splits(evaluator.checkpoint.config) for frame in evaluator.capture.split(split)
    )
    renderer = FrameRenderer(
        Avatar.load(avatar),
        Light(evaluator.checkpoint.probe.numpy()),
        evaluator.capture.cameras[frame.camera],
        shade=evaluator.mode,
        cull=evaluator.cull,
    )
    seconds = []
    for k in range(PLAYED):
        started = time.perf_counter()
        renderer.render(evaluator.motion, (k % evaluator.motion.frame_count) / evaluator.motion.fps)
        seconds.append(time.perf_counter() - started)
    renderer.close()
    return {"file_mb": avatar.stat().st_size / 1e6, "fps": 1 / statistics.median(seconds)}


def sizes(capture: Capture, splits: Iterable[Split]) -> list[tuple[int, int]]:
    """Unique widths and heights in pixels of the images of ``splits``."""
    cameras = (capture.cameras[frame.camera] for split in splits for frame in capture.split(split))
    return sorted({(camera.width, camera.height) for camera in cameras})


def _provenance(checkpoint: Any) -> dict[str, Any]:
    info, config = checkpoint.info, checkpoint.config
    return {
        "minutes": info.get("minutes"),
        "train_threads": info.get("threads"),
        "train_machine": info.get("machine"),
        "train_device": info.get("device"),
        "capture": info.get("capture"),
        "train_motion": info.get("motion"),
        "steps": config.steps,
        "step": info.get("step"),
        "seed": config.seed,
        "gaussians": config.model.gaussians,
        "image_scale": config.image_scale,
        "light": config.light,
        "train_perceptual": info.get("perceptual"),
        "consistency_sha256": info.get("consistency_sha256"),
        "refine_poses": config.refine_poses,
        "hold_out": config.hold_out,
        "threads": numba.get_num_threads(),
        "machine": machine(),
    }
