"""rnd-eval --ablate: a study's trainings, their table on the terminal, their rows and their chart."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rnd_runtime.core.errors import check_option
from rnd_runtime.core.files import write_json
from rnd_trainer.commands.eval import EvalOptions, check_outputs, need_extra, wide_console

if TYPE_CHECKING:
    from rnd_trainer.config import TrainConfig

    from .ablate import StudyRow

MOST_SEEDS = 100


def run_study(options: EvalOptions) -> None:
    """Train a study's rows into the folder ``options.run``; print their table, write rows and summary as JSON."""
    need_extra()
    from rnd_bench.charts import check_chart, draw_lengths
    from rnd_runtime.shading.shader import check_mode

    from .ablate import STUDIES, chosen, summarise, time_encoders

    variants = chosen(STUDIES[options.study], options.variants)
    if options.chart is not None:
        check_chart(options.chart)
        check_option(options.study == "lengths", "--chart", "--study lengths beside it", options.study)
    check_option(options.seeds >= 1, "--seeds", "at least 1", options.seeds)
    check_option(options.seeds <= MOST_SEEDS, "--seeds", f"at most {MOST_SEEDS}", options.seeds)
    check_mode(options.shade)
    check_outputs(options)
    rows = time_encoders(_trained(options, _config(options), variants), options.run, variants, seed=0)
    summary = summarise(rows, variants)
    if options.json is not None:
        write_json(options.json, {"summary": summary, "rows": rows})
    if options.chart is not None:
        draw_lengths(rows, [options.chart])
    _show(summary, options.study)


def _config(options: EvalOptions) -> TrainConfig:
    from rnd_trainer.config import check_sizes, preset, resized

    config = resized(preset(options.preset), options.gaussians, options.steps)
    config = dataclasses.replace(config, image_scale=options.image_scale)
    check_sizes(config)
    return config


def _trained(options: EvalOptions, config: TrainConfig, variants: Sequence[StudyRow]) -> list[dict[str, Any]]:
    """Scores of every row and seed, trained with a progress bar where they were not before."""
    from rich.console import Console
    from rich.progress import Progress

    from rnd_runtime.capture.capture import load_capture
    from rnd_trainer.evaluation.evaluate import HELD_OUT
    from rnd_trainer.losses.perceptual import load_features, load_lpips
    from rnd_trainer.training.notes import capture_notes, say_notes

    from .ablate import ablate, check_needs

    capture = load_capture(options.capture, motion_file=options.motion)
    check_needs(variants, capture)
    say_notes("rnd-eval", capture_notes(capture, HELD_OUT))
    perceptual = load_lpips(options.perceptual_weights)
    console = Console(stderr=True)
    if perceptual is None:
        console.print("rnd-eval: no --perceptual-weights: no LPIPS, and without --consistency-weights no L_gc")
    with Progress(console=console, speed_estimate_period=600) as progress:
        task = progress.add_task("", total=None)

        def on_run(name: str, seed: int, done: float, total: int) -> None:
            progress.update(task, description=f"{name}, seed {seed}", completed=done, total=total)

        return ablate(
            capture,
            config,
            options.run,
            variants,
            seeds=range(options.seeds),
            perceptual=perceptual,
            consistency=load_features(options.consistency_weights),
            mode=options.shade,
            on_run=on_run,
        )


def _show(summary: Sequence[dict[str, Any]], study: str) -> None:
    from rich.table import Table

    splits = [key for key, cell in summary[0].items() if isinstance(cell, dict)]
    table = Table("method", *splits, "read beside", "GFLOP", "ms", title=f"{study}, PSNR")
    for line in summary:
        cells = [_with_gain(line[split]) if split in line else "" for split in splits]
        cost = (f"{line['encoder_gflop']:.3f}", f"{line['encoder_ms']:.1f}")
        table.add_row(line["method"], *cells, line["beside"] or "", *cost)
    wide_console().print(table)


def _with_gain(cell: dict[str, Any]) -> str:
    """Mean ± spread, and the difference to the row it is read beside; in brackets where the seeds differ by more."""
    text = f"{cell['mean']:.2f}" + ("" if cell["spread"] is None else f" ± {cell['spread']:.2f}")
    if "gain" not in cell:
        return text
    gain = f"{cell['gain']:+.2f}"
    return f"{text}  {f'({gain})' if cell['shows'] is False else gain}"
