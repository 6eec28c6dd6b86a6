"""Greedy search for the cheapest file of an avatar that keeps a bound, on this machine.

From the full avatar on, each step is the one that saves most cost per loss of PSNR. Under a bound of time or size,
unnecessary steps are taken back. PSNR is the worst view's, against the full avatar. The result keeps the bound in
held-out views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import onnx

from rnd_export.reduce.variant import Variant
from rnd_runtime.core.errors import InputError
from rnd_trainer.config import ModelConfig

from .candidates import Measured, Recipe, Workbench

PRECISIONS: tuple[Literal["f32", "f16", "int8"], ...] = ("f32", "f16", "int8")
LADDERS: dict[str, tuple[float, ...]] = {
    "precision": (1, 2),
    "cull": (-0.7, -0.5, -0.4, -0.3, -0.2),
    "dynamic_mm": (0.05, 0.2, 0.5, 1.0, 2.0, np.inf),
    "nodes": (0.5, 0.25, 0.125),
    "gaussians": (0.85, 0.7, 0.55, 0.4, 0.3, 0.2),
    "visibility_degree": (2, 1, 0),
    "window": (0.5, 0.3, 0.2),
}
"""steps of each choice; nodes, Gaussians and window poses as shares of the checkpoint's"""
MARGIN_DB = 0.3  # above a required PSNR: held-out views are a little worse
MIN_GAIN = 0.01  # share of the cost that a step must save; smaller steps only when none is left


@dataclass(frozen=True)
class Bound:
    """``ms`` a frame at most, ``psnr`` (dB) at least, or ``mb`` (1e6 bytes) at most."""

    kind: Literal["ms", "psnr", "mb"]
    value: float

    def kept_by(self, found: Measured) -> bool:
        value: float = getattr(found, self.kind)
        return value >= self.value if self.kind == "psnr" else value <= self.value


@dataclass(frozen=True)
class Plan:
    """A file as the number of steps on each of ``LADDERS``."""

    precision: int = 0
    cull: int = 0
    dynamic_mm: int = 0
    nodes: int = 0
    gaussians: int = 0
    visibility_degree: int = 0
    window: int = 0

    def recipe(self, config: ModelConfig) -> Recipe:
        """The recipe for a checkpoint of ``config``."""

        def rung(name: str) -> float | None:
            at = getattr(self, name)
            return LADDERS[name][at - 1] if at else None

        nodes, gaussians, window, degree = (rung(n) for n in ("nodes", "gaussians", "window", "visibility_degree"))
        static = rung("dynamic_mm") == np.inf
        node_count = _nodes(nodes, config.nodes) or config.nodes
        variant = Variant(
            encoder="coarse" if nodes else "full",
            precision=PRECISIONS[self.precision],
            nodes=_nodes(nodes, config.nodes),
            window_poses=max(2, round(window * config.window_poses)) if window and not static else None,
            visibility_degree=3 if degree is None else int(degree),
        )
        count = max(int(gaussians * config.gaussians), node_count) if gaussians else None
        return Recipe(variant, count, rung("dynamic_mm") or 0.0, rung("cull"))


def _nodes(share: float | None, count: int) -> int | None:
    return None if share is None else min(max(16, int(share * count)), count)


@dataclass(frozen=True, eq=False)
class Found:
    """A plan, its file, and measurements in the views of the search and, at the end, in held-out ones."""

    plan: Plan
    model: onnx.ModelProto
    measured: Measured
    held_out: Measured | None = None


def search(bench: Workbench, bound: Bound, on_step: Callable[[Found], None]) -> Found:
    """The cheapest file that keeps ``bound``, in held-out views too; ``on_step`` is called with every step."""
    path, worths = [_make(bench, Plan())], dict.fromkeys(LADDERS, np.inf)
    on_step(path[-1])
    while True:
        now = path[-1]
        if bound.kind != "psnr" and bound.kept_by(now.measured):
            now = path[-1] = _tested(bench, now)
            if _holds(bound, now):
                return _relaxed(bench, bound, now, on_step)
        step = _best_step(bench, bound, now, worths)
        if step is None and bound.kind != "psnr":  # small steps may add up
            step, worths = _mildest_step(bench, bound, now), dict.fromkeys(LADDERS, np.inf)
        if step is None:
            break
        path.append(step)
        on_step(step)
    for found in reversed(path):
        tested = _tested(bench, found)
        if _holds(bound, tested):
            return tested
    raise InputError(
        f"no file keeps the bound of {bound.kind}",
        expected=f"{bound.value:g}",
        got=f"{getattr(path[-1].measured, bound.kind):.3g} at the end of all steps",
    )


def _relaxed(bench: Workbench, bound: Bound, found: Found, on_step: Callable[[Found], None]) -> Found:
    """``found`` with steps taken back while ``bound`` holds, in each round the one that gains most PSNR."""
    while True:
        plans = [_next(bench, found.plan, name, -1) for name in LADDERS]
        made = [_make(bench, plan) for plan in plans if plan is not None]
        gains = (f for f in made if bound.kept_by(f.measured) and f.measured.psnr > found.measured.psnr)
        for candidate in sorted(gains, key=_squared_error):
            tested = _tested(bench, candidate)
            if _holds(bound, tested):
                found = tested
                on_step(found)
                break
        else:
            return found


def _tested(bench: Workbench, found: Found) -> Found:
    """``found``, measured in held-out views too, once."""
    return found if found.held_out else replace(found, held_out=bench.measure(found.model, bench.held_out))


def _holds(bound: Bound, found: Found) -> bool:
    return found.held_out is not None and bound.kept_by(found.held_out)


def _best_step(bench: Workbench, bound: Bound, now: Found, worths: dict[str, float]) -> Found | None:
    """The step that saves most cost per loss of PSNR.

    Args:
        worths: savings per loss of each ladder in earlier rounds; only the most promising ladders are measured.
    """
    made: dict[str, Found] = {}
    while True:
        name = max(worths, key=lambda name: worths[name])
        if worths[name] <= 0:
            return None
        if name in made:
            return made[name]
        found = _further(bench, bound, now, name, MIN_GAIN)
        if found is None or (bound.kind == "psnr" and found.measured.psnr < bound.value + MARGIN_DB):
            worths[name] = 0
            continue
        worths[name] = _saved(bound, now, found) / max(_squared_error(found) - _squared_error(now), 1e-9)
        made[name] = found


def _mildest_step(bench: Workbench, bound: Bound, now: Found) -> Found | None:
    """The step that loses least PSNR; under a bound of size, one that makes the file smaller."""
    least = 0.0 if bound.kind == "mb" else -np.inf  # a saved time may be noise
    steps = [_further(bench, bound, now, name, least) for name in LADDERS]
    return min((step for step in steps if step is not None), key=_squared_error, default=None)


def _further(bench: Workbench, bound: Bound, now: Found, name: str, least: float) -> Found | None:
    """The next rung of ladder ``name`` that saves more than ``least`` of the cost, or None.

    Early rungs may save nothing: dynamic skinning saves size only once all of it is static.
    """
    plan = _next(bench, now.plan, name, 1)
    while plan is not None:
        found = _make(bench, plan)
        if _saved(bound, now, found) > least:
            return found
        plan = _next(bench, plan, name, 1)
    return None


def _saved(bound: Bound, now: Found, found: Found) -> float:
    """Share of the cost (size for a bound of size, else time) that ``found`` saves over ``now``."""
    cost = "mb" if bound.kind == "mb" else "ms"
    return float(1 - getattr(found.measured, cost) / getattr(now.measured, cost))


def _next(bench: Workbench, plan: Plan, name: str, direction: Literal[1, -1]) -> Plan | None:
    """The next rung of ladder ``name``, down (1) or up (−1), with a different, allowed file; None at its end."""
    last = len(LADDERS[name]) if direction > 0 else 0
    for rung in range(getattr(plan, name) + direction, last + direction, direction):
        other = replace(plan, **{name: rung})
        recipe = other.recipe(bench.config)
        if recipe != plan.recipe(bench.config) and bench.allows(recipe.variant.precision):
            return other
    return None


def _make(bench: Workbench, plan: Plan) -> Found:
    model = bench.model(plan.recipe(bench.config))
    return Found(plan, model, bench.measure(model, bench.search))


def _squared_error(found: Found) -> float:
    return float(10 ** (-found.measured.psnr / 10))


def given_up(bench: Workbench, plan: Plan) -> list[str]:
    """The reductions of ``plan``, a phrase each."""
    recipe, config = plan.recipe(bench.config), bench.config
    lines = []
    if recipe.cull is not None:
        lines.append(f"what faces away (n·v < {recipe.cull:g})")
    if recipe.gaussians is not None:
        lines.append(f"{recipe.gaussians} of {config.gaussians} Gaussians, the others merged, colours fitted again")
    if recipe.variant.nodes is not None:
        lines.append(f"networks at {recipe.variant.nodes} of {config.nodes} nodes")
    if recipe.dynamic_mm == np.inf:
        lines.append("dynamic skinning nowhere")
    elif recipe.dynamic_mm:
        share = bench.still_share(recipe)
        lines.append(f"dynamic skinning where it moves less than {recipe.dynamic_mm:g} mm ({share:.0%} of its nodes)")
    if recipe.variant.visibility_degree < 3:
        lines.append(f"visibility above degree {recipe.variant.visibility_degree}")
    if recipe.variant.window_poses is not None:
        lines.append(f"{config.window_poses - recipe.variant.window_poses} of {config.window_poses} window poses")
    if recipe.variant.precision != "f32":
        lines.append(f"constants of 32 bits: {recipe.variant.precision}")
    return lines or ["nothing"]
