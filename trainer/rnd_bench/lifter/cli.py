"""``rnd-bench study lifter``."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from rnd_runtime.cli.command import log
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.files import output_file, output_folder, sha256_of, write_json
from rnd_runtime.playback.doctor import machine
from rnd_trainer.estimating.observing.networks import network_file

from .captured import observed, window_of_capture
from .figures import Lifts, of_windows, rows_of
from .filming import Studio, filmed, load_films, save_films
from .motions import load_clips
from .network import export
from .options import Lifter
from .people import prepare
from .pose2sim import figures_of_cameras
from .training import train

HELD_OUT = 192
"""windows of the validation and of the test, at most a tenth of the training's"""
SEEDS = {"validation": 0, "test": 1, "train": 2}
COLUMNS = (
    "limbs_deg",
    "limbs_deg_landmarks",
    "root_relative_mm",
    "root_relative_mm_landmarks",
    "pa_mm",
    "pa_mm_landmarks",
)


def run(options: Lifter) -> None:
    """Film, train, score; print the table, write the rows."""
    options.check()
    out = output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    name = ("cuda" if torch.cuda.is_available() else "cpu") if options.device == "auto" else options.device
    device = torch.device(name)
    seconds = options.seconds or np.inf
    network = out / "lifter.onnx"
    spawn = multiprocessing.get_context("spawn")
    with Progress() as progress, ProcessPoolExecutor(mp_context=spawn) as pool:
        parts = ("validation", "test") if network.exists() else ("validation", "test", "train")
        missing = [part for part in parts if not (out / f"films_{part}.npz").exists()]
        if missing:
            progress.phase("people")
            people = prepare(options.characters, output_folder(out / "people"))
            studio = Studio(people, options.lights, network_file("pose_landmarks"), device)
            clips = load_clips(options.motions)
        for part in missing:
            own = part == "train"
            count = options.windows if own else min(HELD_OUT, options.windows // 10)
            progress.phase(f"filming, {part}", count)
            limit, seed = seconds if own else np.inf, SEEDS[part]
            seen = filmed(studio, clips[part], count, seed, pool, augment=own, seconds=limit, on_batch=progress.update)
            save_films(out / f"films_{part}.npz", seen)
        films = {part: load_films(out / f"films_{part}.npz") for part in parts}
        if not network.exists():
            progress.phase("training", options.steps)

            def on_step(step: int, loss: float) -> None:
                progress.update(step, loss=loss)

            trained = train(films["train"], films["validation"], options.steps, device, pool, on_step, seconds=seconds)
            export(trained.network, network)
            write_json(out / "training.json", {"windows": len(films["train"]), "device": name, "curve": trained.curve})
        log(f"{network}: sha256 {sha256_of(network)[:12]}")
        progress.phase("landmarks of the rendered person")
        dancer = window_of_capture(options.capture, observed(options.video, out / "observations.npz"))

        def scored() -> Iterator[tuple[str, Lifts]]:
            for part in ("validation", "test"):
                progress.phase(f"scoring, {part}")
                yield f"filmed, {part}", of_windows(films[part], network)
            yield "rendered person", of_windows([dancer], network)

        rows = rows_of(scored())
        if options.real is not None:
            progress.phase("scoring, real cameras")
            rows += figures_of_cameras(options.real, network, out)
    if options.json is not None:
        write_json(
            options.json,
            {"machine": machine(), "training": json.loads((out / "training.json").read_text()), "rows": rows},
        )
    table = Table("set", "frames", *COLUMNS, title="lifter beside the landmark network's own 3D")
    for row in rows:
        table.add_row(row["set"], str(row["frames"]), *(f"{row[name]:.1f}" for name in COLUMNS))
    Console(width=140, soft_wrap=True).print(table)
