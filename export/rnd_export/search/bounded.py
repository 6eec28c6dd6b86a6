"""rnd-export with a bound: the search is shown step by step, its file written, and what was found recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import onnx
from numba import get_num_threads
from rich.console import Console

from rnd_export.cli import BOUNDS, Options
from rnd_export.export import export
from rnd_export.reduce.shots import shots_of
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.console import print_plain
from rnd_runtime.core.errors import InputError, flag
from rnd_runtime.core.files import atomic_path, earlier_rows, write_json
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.light import Light, light_notes, load_light
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.training.notes import say_notes

from .budget import Bound, Found, given_up, search
from .candidates import Scene, Workbench


def export_bounded(
    options: Options, checkpoint: Checkpoint, out: Path, motion: Motion, given: dict[str, float]
) -> None:
    """Write the cheapest file that keeps the bound ``given`` {kind: value}, and say what it gave up.

    It is looked for in the views of ``options.capture``, or where there is none in shots of ``motion``.

    Raises ``InputError`` for several bounds, one that is not positive, or one that no file keeps.
    """
    if len(given) > 1:
        raise InputError("bounds", expected=f"one of {', '.join(map(flag, BOUNDS.values()))}", got=f"{len(given)}")
    ((kind, value),) = given.items()
    if not value > 0:
        raise InputError(flag(BOUNDS[kind]), expected="more than 0", got=value)
    rows = (
        [] if options.json is None else earlier_rows(options.json, what="rows of an earlier search", names=("bound",))
    )
    started = perf_counter()
    light = Light(checkpoint.probe.numpy()) if options.hdr is None else load_light(options.hdr, up=options.hdr_up)
    if options.hdr is not None:
        say_notes("rnd-export", light_notes(light))
    if options.capture is None:
        scene = Scene(motion, light, options.size)
    else:
        capture = load_capture(options.capture)
        moves = capture.motion_for(checkpoint.skeleton)
        say_notes("rnd-export", moves.notes)
        scene = Scene(moves, light, options.size, shots=shots_of(capture, options.size))
    # all that follows is held against the whole avatar: it has to be torch's
    with TemporaryDirectory() as folder:
        export(checkpoint, Path(folder) / "avatar.onnx", motion, cull=-1)
    bench = Workbench(checkpoint, scene)
    console, steps = Console(), []

    def show(found: Found) -> None:
        steps.append(found)
        what = found.measured
        line = f"{what.ms:7.2f} ms {what.mb:6.2f} MB {what.psnr:6.1f} dB  {', '.join(given_up(bench, found.plan))}"
        console.print(line, highlight=False, soft_wrap=True)

    found = search(bench, Bound(kind, value), show)  # type: ignore[arg-type]
    while bench.recalibrated():
        if kind == "ms":
            console.print("the machine was busy when the search began, and is calmer now: it begins again")
            steps.clear()
            found = search(bench, Bound(kind, value), show)  # type: ignore[arg-type]
        else:  # what was chosen is the same; what is told of it is not
            found = replace(found, held_out=bench.measure(found.model, bench.held_out))
            steps[0] = replace(steps[0], measured=bench.measure(steps[0].model, bench.seen))
    with atomic_path(out) as temporary:
        onnx.save_model(found.model, str(temporary))
    assert found.held_out is not None
    held, lost = found.held_out, "; ".join(given_up(bench, found.plan))
    usual = bench.usual_times(found.model)
    median, p95 = float(np.median(usual)), float(np.percentile(usual, 95))
    print_plain(
        console,
        f"{out}: {held.mb:.2f} MB, {held.ms:.2f} ms and {held.psnr:.1f} dB in shots that the search has not seen "
        f"(in this machine's calm moments; just now {median:.1f} ms, 95 frames of a hundred within {p95:.1f}). "
        f"Given up: {lost}",
    )
    if options.json is not None:
        row = {
            "bound": f"{flag(BOUNDS[kind])} {value:g}",
            "given_up": lost,
            "ms": held.ms,
            "ms_median": median,
            "ms_p95": p95,
            "mb": held.mb,
            "psnr_db": held.psnr,
            "whole_ms": steps[0].measured.ms,
            "whole_mb": steps[0].measured.mb,
            "steps": len(steps) - 1,
            "minutes": (perf_counter() - started) / 60,
            "gaussians": bench.config.gaussians,
            "size": options.size,
            "shade": scene.shade,
            "shots": "around" if options.capture is None else "capture",
            "threads": get_num_threads(),
            "machine": machine(),
        }
        write_json(options.json, [*(old for old in rows if old["bound"] != row["bound"]), row])
