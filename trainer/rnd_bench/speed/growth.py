"""How the stages of a frame grow with Gaussians, pixels, lights and joints, and the floor beside each.

Growth is the exponent p of time ~ amount^p, by least squares over logarithms. The floor is what no program could beat
at the largest amount: the bytes that a stage must read and write once over the bandwidth measured here, or its
operations over the rate measured here, whichever takes longer. A stage far above its floor spends its time on
something else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numba
import numpy as np
import torch

from rnd_runtime.playback.doctor import machine
from rnd_runtime.posing.posing import RestPose
from rnd_trainer.config import nodes_for
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.model.model import AvatarModel

from .clock import times
from .point import Inputs, Row, Setting, measured

SECONDS = 3.0  # of frames at each amount
COPIED = 64 << 20  # bytes: past every cache
MULTIPLIED = 1024  # side of the matrices that the rate is measured with
PER_GAUSSIAN = ("encoders", "posing", "projection", "shading", "sort", "raster")
PER_PIXEL = ("sort", "raster", "tone map")


@dataclass(frozen=True)
class Amounts:
    """What is varied; the usual amounts, or fewer for a quick look. The last but one of ``gaussians`` is the usual."""

    gaussians: tuple[int, ...] = (4_000, 8_000, 15_000, 30_000, 60_000)
    sides: tuple[int, ...] = (256, 512, 1024)
    lights: tuple[int, ...] = (8, 32, 128)
    joints: tuple[int, ...] = (12, 24, 48)


@dataclass(frozen=True)
class Rates:
    """What this machine can do on the threads used: bytes and float32 operations per second."""

    bandwidth: float
    operations: float

    def seconds(self, moved: float, operations: float = 0.0) -> float:
        """The least time for both."""
        return max(moved / self.bandwidth, operations / self.operations)


def growth(inputs: Inputs, amounts: Amounts, size: int, threads: int) -> list[Row]:
    """A row for each stage and amount: ``exponent``, ``ms`` at each of ``amounts``, ``floor_ms`` at the last.

    Frames are the grid's (``speed.point.measured``), of seeded avatars. Joints are varied in a rest
    pose made up for it: an avatar has those of its body.
    """
    rates = measured_rates(threads)
    known = {
        "bandwidth_gb_s": rates.bandwidth / 1e9,
        "rate_gflop_s": rates.operations / 1e9,
        "threads": threads,
        "machine": machine(),
    }
    return [row | known for row in (*_frames(inputs, amounts, size, threads, rates), _joints(amounts, threads, rates))]


def _frames(inputs: Inputs, amounts: Amounts, size: int, threads: int, rates: Rates) -> Iterator[Row]:
    seeded = replace(inputs, checkpoints=())
    usual = Setting(n=amounts.gaussians[-2], size=size, shade="table", threads=threads)
    series = (
        ("Gaussians", amounts.gaussians, PER_GAUSSIAN, [replace(usual, n=n) for n in amounts.gaussians]),
        ("picture side", amounts.sides, PER_PIXEL, [replace(usual, size=side) for side in amounts.sides]),
        ("lights", amounts.lights, ("shading",), [replace(usual, shade=f"lights:{k}") for k in amounts.lights]),
    )
    taken: dict[Setting, dict[str, float]] = {}
    for what, values, stages, settings in series:
        for setting in settings:
            if setting not in taken:
                taken[setting] = measured(setting, seeded, seconds=SECONDS, compare=False)["stages"]
        model = load_checkpoint(seeded.source(settings[-1].n)[0]).model
        floor = floors(settings[-1], model, rates)
        for stage in stages:
            yield _row(stage, what, values, [taken[setting][stage] for setting in settings], floor[stage])


def floors(setting: Setting, model: AvatarModel, rates: Rates) -> dict[str, float]:
    """Seconds that each stage of a frame of ``model`` takes at least, by table or ``lights:K``.

    Bytes are those of the runtime's arrays: a Gaussian's mean, covariance and opacity are 40, its centre, shape, box,
    depth and slot on the screen 64, all that is shaded 116; a pixel's radiance and coverage 16, its colour 3.
    """
    n, pixels = setting.n, setting.size**2
    lights = int(setting.shade.partition(":")[2] or 0)
    return {
        "encoders": rates.seconds(0.0, encoder_operations(model)),
        "posing": posing_floor(n, len(model.encoded_nodes()), model.log_weights.shape[1], rates),
        "projection": rates.seconds(104 * n),
        "shading": rates.seconds(116 * n, 90 * n * lights),
        "sort": rates.seconds(36 * n),
        "raster": rates.seconds(44 * n + 16 * pixels),
        "tone map": rates.seconds(19 * pixels),
    }


def posing_floor(n: int, nodes: int, joints: int, rates: Rates) -> float:
    """Seconds to blend ``joints`` bones at ``n`` Gaussians, with what the networks said at ``nodes``."""
    return rates.seconds(4 * n * (joints + 58) + 4 * nodes * (joints + 22), n * (34 * joints + 600))


def encoder_operations(model: AvatarModel) -> float:
    """Multiplications and additions at the nodes in one frame, without what depends on a node's place alone.

    The skinning's two attentions are two products over all joints and heads (``rnd_export.build.networks``); what
    is done once per joint is left out.
    """
    weights = dict(model.named_parameters())
    heads = 2 * model.config.heads * (model.log_weights.shape[1] - 1)
    per_node = 2 * model.config.width * heads
    names = (
        "skinning.hidden",
        "skinning.logits",
        "offsets.hidden",
        "offsets.out",
        "visibility.from_extra",
        "visibility.hidden",
        "visibility.out",
    )
    per_node += sum(weights[f"{name}.weight"].numel() for name in names)
    return 2.0 * per_node * len(model.encoded_nodes())


def _joints(amounts: Amounts, threads: int, rates: Rates) -> Row:
    """Posing of the usual number of Gaussians by skeletons of several sizes."""
    n = amounts.gaussians[-2]
    nodes, before = nodes_for(n), numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        taken = []
        for joints in amounts.joints:
            rest, *arguments = _rest(n, nodes, joints)
            taken.append(times(partial(rest.pose, *arguments))["ms_median"])
    finally:
        numba.set_num_threads(before)
    return _row("posing", "joints", amounts.joints, taken, posing_floor(n, nodes, amounts.joints[-1], rates))


def _row(stage: str, what: str, values: Sequence[int], milliseconds: list[float], floor: float) -> Row:
    exponent = float(np.polyfit(np.log(values), np.log(milliseconds), 1)[0])
    return {
        "stage": stage,
        "of": what,
        "amounts": list(values),
        "ms": milliseconds,
        "exponent": exponent,
        "floor_ms": 1e3 * floor,
    }


def measured_rates(threads: int) -> Rates:
    """A copy that no cache holds, and a large product of matrices."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        source, target = torch.ones(COPIED // 4), torch.empty(COPIED // 4)
        copied = times(lambda: target.copy_(source))["ms_min"]
        a = torch.ones(MULTIPLIED, MULTIPLIED)
        multiplied = times(lambda: a @ a)["ms_min"]
    finally:
        torch.set_num_threads(before)
    return Rates(2e3 * COPIED / copied, 2e3 * MULTIPLIED**3 / multiplied)


def _rest(count: int, nodes: int, joints: int) -> tuple[Any, ...]:
    """A rest pose of any number of joints, with node fields and bones, as ``RestPose.pose`` takes them."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> Any:
        return rng.normal(size=shape).astype(np.float32)

    near = np.arange(count)[:, None] * nodes // count + np.arange(4)  # files lie in the order of places
    neighbours = np.minimum(near, nodes - 1).astype(np.int32)
    rest = RestPose(
        neighbours,
        np.full((count, 4), 0.25, np.float32),
        normal(count, joints),
        normal(count, 3),
        0.01 * normal(count, 9),
        normal(count, 3),
        normal(count, 7),
        0.06,
        1e-8,
        1e-3,
    )
    bones = np.tile(np.eye(3, 4, dtype=np.float32), (joints, 1, 1))
    return rest, normal(nodes, joints), normal(nodes, 6), normal(nodes, 16), bones
