"""rnd-export with a bound: run the search, print its steps, write the file and a row of results."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import onnx
from numba import get_num_threads

from rnd_export.export import export
from rnd_export.reduce.views import views_of
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.files import atomic_path, earlier_rows, write_json
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, Up, light_notes
from rnd_trainer.model.checkpoint import Checkpoint

from .budget import Bound, Found, given_up, search
from .candidates import SearchScene, Workbench


@dataclass(frozen=True)
class BoundedSearch:
    """A bound, its ``option``, and the views of the search: those of ``capture``, or around ``motion``.

    ``size`` is (width, height or None); ``hdr`` by default the learned light; a row is added to the file ``json``.
    """

    bound: Bound
    option: str
    motion: Motion
    size: tuple[int, int | None]
    hdr: Path | None = None
    hdr_up: Up = "y"
    capture: Path | None = None
    json: Path | None = None


def export_bounded(
    checkpoint: Checkpoint,
    out: Path,
    what: BoundedSearch,
    *,
    show: Callable[[str], None],
    warn: Callable[[Iterable[str]], None],
) -> str:
    """Write the cheapest file of ``checkpoint`` that keeps the bound; ``show`` the steps and return a summary.

    Raises:
        InputError: no file keeps the bound, or the full avatar's file differs from torch.
    """
    rows = [] if what.json is None else earlier_rows(what.json, what="rows of an earlier search", names=("bound",))
    started = perf_counter()
    scene = _scene(checkpoint, what, warn)
    with temporary_folder() as folder:  # checks the reference of the search against torch
        export(checkpoint, folder / "avatar.onnx", what.motion, cull=-1)
    bench, steps = Workbench(checkpoint, scene), []

    def on_step(found: Found) -> None:
        steps.append(found)
        got = found.measured
        show(f"{got.ms:7.2f} ms {got.mb:6.2f} MB {got.psnr:6.1f} dB  {', '.join(given_up(bench, found.plan))}")

    found = search(bench, what.bound, on_step)
    while bench.recalibrated():
        if what.bound.kind == "ms":
            show("the machine was busy when the search began: it begins again")
            steps.clear()
            found = search(bench, what.bound, on_step)
        else:  # only the reported times are measured again
            found = replace(found, held_out=bench.measure(found.model, bench.held_out))
            steps[0] = replace(steps[0], measured=bench.measure(steps[0].model, bench.search))
    with atomic_path(out) as temporary:
        onnx.save_model(found.model, str(temporary))
    assert found.held_out is not None
    held_out, lost = found.held_out, "; ".join(given_up(bench, found.plan))
    usual = bench.usual_times(found.model)
    median, p95 = float(np.median(usual)), float(np.percentile(usual, 95))
    summary = (
        f"{held_out.mb:.2f} MB, {held_out.ms:.2f} ms and {held_out.psnr:.1f} dB in held-out views "
        f"(on the idle machine; now {median:.1f} ms, p95 {p95:.1f} ms). Given up: {lost}"
    )
    if what.json is None:
        return summary
    row = {
        "bound": f"{what.option} {what.bound.value:g}",
        "given_up": lost,
        "ms": held_out.ms,
        "ms_median": median,
        "ms_p95": p95,
        "mb": held_out.mb,
        "psnr_db": held_out.psnr,
        "whole_ms": steps[0].measured.ms,
        "whole_mb": steps[0].measured.mb,
        "steps": len(steps) - 1,
        "minutes": (perf_counter() - started) / 60,
        "gaussians": bench.config.gaussians,
        "size": what.size[0] if what.size[1] is None else list(what.size),
        "shade": scene.shade,
        "shots": "around" if what.capture is None else "capture",
        "threads": get_num_threads(),
        "machine": machine(),
    }
    write_json(what.json, [*(old for old in rows if old["bound"] != row["bound"]), row])
    return summary


def _scene(checkpoint: Checkpoint, what: BoundedSearch, warn: Callable[[Iterable[str]], None]) -> SearchScene:
    light = Light(checkpoint.probe.numpy()) if what.hdr is None else load_light(what.hdr, up=what.hdr_up)
    size = what.size[0], what.size[1] or what.size[0]
    if what.hdr is not None:
        warn(light_notes(light))
    if what.capture is None:
        return SearchScene(what.motion, light, size)
    capture = load_capture(what.capture)
    motion = capture.motion_for(checkpoint.skeleton)
    warn(motion.notes)
    return SearchScene(motion, light, size, views=views_of(capture, max(size), checkpoint.config.hold_out))
