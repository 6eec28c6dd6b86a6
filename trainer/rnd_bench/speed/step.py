"""Time of a training step by kind of operation, from torch's profiler."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from typing import Any

import numba
from torch.profiler import ProfilerActivity, profile

from rnd_runtime.capture.capture import Capture
from rnd_runtime.playback.doctor import machine
from rnd_trainer.config import TrainConfig, resized
from rnd_trainer.evaluation.held_out import sizes
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.training.training import Training

KINDS = {
    "our posing": "PoseGaussians|_Interpolate",
    "our shading": "FusedShade",
    "our splatting": "_CpuRasterizer",
    "our SSIM": "MeanSsim",
    "perceptual network": "convolution|max_pool|grid_sampler",
    "matrix products": r"aten::(mm|addmm|bmm|baddbmm|matmul)$",
}
"""kind: pattern of an operation's name, which its gradient's contains"""
OPTIMISER, OPTIMISING = "optimiser", "Optimizer.step#"  # operations within an event of this name are the optimiser's
REST, OUTSIDE = "element by element", "outside operations"
WARMUP = 4


def bench_step(
    capture: Capture,
    config: TrainConfig,
    perceptual: Perceptual | None,
    *,
    repeats: int = 24,
    on_step: Callable[[int], None] = lambda done: None,
) -> list[dict[str, Any]]:
    """Milliseconds of a step of the second stage, in total and by kind; the profiler adds a few per cent."""
    within = 1 - config.stage1_fraction - config.full_light_fraction
    steps = math.ceil((repeats + WARMUP + 1) / within)
    training = Training(capture, resized(config, None, steps), perceptual)
    first = training.schedule.first_stage + WARMUP
    for done in range(first):
        on_step(done)
        training.step()
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        started = time.perf_counter()
        for done in range(repeats):
            on_step(first + done)
            training.step()
        whole = 1e3 * (time.perf_counter() - started) / repeats
    spent = {kind: ms / repeats for kind, ms in spent_by_kind(profiled).items()}
    spent[OUTSIDE] = whole - sum(spent.values())
    common = {
        "gaussians": config.model.gaussians,
        "image_scale": config.image_scale,
        "repeats": repeats,
        "perceptual": None if perceptual is None else perceptual.backbone,
        "capture": capture.folder.resolve().name,
        "size": sizes(capture, ("train",)),
        "threads": numba.get_num_threads(),
        "machine": machine(),
    }
    ranked = sorted(spent.items(), key=lambda item: -item[1])
    return [{"what": what, "ms": ms, "share": ms / whole, **common} for what, ms in (("a step", whole), *ranked)]


def spent_by_kind(profiled: profile) -> dict[str, float]:
    """Milliseconds by kind, each operation without those that it calls."""
    spent = dict.fromkeys((*KINDS, OPTIMISER, REST), 0.0)
    for operation in profiled.events() or ():
        caller = operation
        while caller is not None and not caller.name.startswith(OPTIMISING):
            caller = caller.cpu_parent
        kind = kind_of(operation.name) if caller is None else OPTIMISER
        spent[kind] += 1e-3 * operation.self_cpu_time_total
    return spent


def kind_of(operation: str) -> str:
    return next((kind for kind, pattern in KINDS.items() if re.search(pattern, operation)), REST)
