"""``rnd-bench study``: trainings of many variants, and studies on the light stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rnd_runtime.capture.capture import capture_file, load_capture
from rnd_runtime.cli.command import log, warn
from rnd_runtime.cli.jobs import run_jobs, workers
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import output_file, output_folder, refuse_input, write_json
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.shader import check_mode
from rnd_stage.film.plan import check_step
from rnd_stage.variants import need_extra, use_variant
from rnd_trainer.config import TrainConfig, check_sizes, preset, resized
from rnd_trainer.evaluation.evaluate import HELD_OUT
from rnd_trainer.losses.perceptual import load_features, load_lpips
from rnd_trainer.training.notes import capture_notes

from .options import Ablations, Agreement, Causes, Lengths, People, Trainings
from .summary import summarise
from .trainings import ablate, check_needs, time_encoders
from .variants import CAUSES, LENGTHS, VARIANTS, StudyRow, chosen

STUDIES: dict[type[Trainings], tuple[StudyRow, ...]] = {Ablations: VARIANTS, Causes: CAUSES, Lengths: LENGTHS}
MAX_SEEDS = 100
WIDTH = 140  # characters of the widest table


def run_trainings(options: Trainings) -> None:
    """Train a study's variants; print their table, write summary and rows."""
    variants = chosen(STUDIES[type(options)], options.variants)
    check_option(1 <= options.seeds <= MAX_SEEDS, "--seeds", f"1 to {MAX_SEEDS}", options.seeds)
    check_mode(options.shade)
    if options.json is not None:
        refuse_input(
            options.json, capture_file(options.capture), options.perceptual_weights, options.consistency_weights
        )
        output_file(options.json)
    config = resized(preset(options.preset), options.gaussians, options.steps)
    config = dataclasses.replace(config, image_scale=options.image_scale, hold_out=options.hold_out)
    check_sizes(config)
    seeds = range(options.seeds)
    if options.on is not None:
        jobs = [(options, config, [variant], [seed]) for seed in seeds for variant in variants]
        with workers(options.on) as client:
            run_jobs(client, train_variants, jobs, name="trainings")
    rows = time_encoders(train_variants(options, config, variants, seeds), options.run, variants, seed=0)
    summary = summarise(rows, variants)
    if options.json is not None:
        write_json(options.json, {"summary": summary, "rows": rows})
    _show(summary, type(options).__name__.lower())


def train_variants(
    options: Trainings, config: TrainConfig, variants: Sequence[StudyRow], seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Scores of every variant and seed; missing ones are trained."""
    capture = load_capture(options.capture, motion_file=options.motion)
    check_needs(variants, capture)
    for note in capture_notes(capture, HELD_OUT):
        log(note)
    perceptual = load_lpips(options.perceptual_weights)
    if perceptual is None:
        warn("no --perceptual-weights: no LPIPS, and without --consistency-weights no L_gc")
    with Progress() as progress:
        progress.phase("trainings", len(variants) * len(seeds))

        def on_run(name: str, seed: int, done: float, total: int) -> None:
            progress.update(done, step=f"{name}, seed {seed}, {done:.2f}/{total}")

        return ablate(
            capture,
            config,
            options.run,
            variants,
            seeds=seeds,
            perceptual=perceptual,
            consistency=load_features(options.consistency_weights),
            mode=options.shade,
            on_run=on_run,
        )


def _show(summary: Sequence[dict[str, Any]], study: str) -> None:
    splits = [key for key, cell in summary[0].items() if isinstance(cell, dict)]
    table = Table("method", *splits, "read beside", "GFLOP", "ms", title=f"{study}, PSNR")
    for line in summary:
        cells = [_with_gain(line[split]) if split in line else "" for split in splits]
        cost = (f"{line['encoder_gflop']:.3f}", f"{line['encoder_ms']:.1f}")
        table.add_row(line["method"], *cells, line["beside"] or "", *cost)
    _wide_console().print(table)


def _check_sheet(file: Path | None) -> None:
    if file is not None:
        check_option(file.suffix.lower() == ".png", "--sheet", "a .png", file.name)


def _with_gain(cell: dict[str, Any]) -> str:
    """Mean ± deviation, and the gain over the variant beside; in brackets where the seeds differ by more."""
    text = f"{cell['mean']:.2f}" + ("" if cell["spread"] is None else f" ± {cell['spread']:.2f}")
    if "gain" not in cell:
        return text
    gain = f"{cell['gain']:+.2f}"
    return f"{text}  {f'({gain})' if cell['shows'] is False else gain}"


def _wide_console() -> Console:
    return Console(width=max(Console().width, WIDTH), soft_wrap=True)


def run_people(options: People) -> None:
    """Render every subject, train, score; print the means, write the rows."""
    need_extra()
    options.sizes.check()
    _check_sheet(options.sheet)
    variant = use_variant(options.variant)
    from .people import FIGURES, SKIN_KNOWN, film_subjects, looks_before, run_study, write_sheet

    variants = chosen(list({row.name: row for row in (*VARIANTS, *CAUSES, SKIN_KNOWN)}.values()), options.methods)
    perceptual, judge = load_lpips(options.perceptual_weights), load_lpips(options.judge_weights)
    output_folder(options.out)
    for file in filter(None, (options.json, options.sheet)):
        output_file(file)
    with Progress() as progress:
        progress.phase("rendering")
        film_subjects(
            options.sizes, options.out, variant, lambda done, total: progress.update(done, step=f"{done}/{total}")
        )
        progress.phase("trainings")

        def on_run(what: str, done: float, total: int) -> None:
            progress.update(done, step=f"{what}, {done:.2f}/{total}")

        result = run_study(options.sizes, options.out, variants, perceptual=perceptual, judge=judge, on_run=on_run)
    if options.json is not None:
        write_json(options.json, {"looks": looks_before(options.json) + 1, **result})
    if options.sheet is not None:
        write_sheet(options.sizes, options.out, variants[0], options.sheet)
    table = Table("method", "split", *FIGURES, title=f"means of {options.sizes.subjects} subjects")
    for line in result["means"]:
        cells = ("" if line[figure] is None else f"{line[figure]:.4g}" for figure in FIGURES)
        table.add_row(line["method"], line["split"], *cells)
    _wide_console().print(table)


def run_agreement(options: Agreement) -> None:
    """Compare with Mitsuba under every light; print the table, write rows and images."""
    need_extra()
    check_option(options.size >= 16, "--size", "at least 16", options.size)
    check_option(options.samples >= 2, "--samples", "at least 2", options.samples)
    check_step(options.step)
    _check_sheet(options.sheet)
    for file in filter(None, (options.json, options.sheet)):
        output_file(file)
    variant = use_variant(options.variant)
    from rnd_stage.film.cameras import ring_cameras
    from rnd_stage.film.dances import dance
    from rnd_stage.people.dressing import Wearer, dress
    from rnd_stage.people.subjects import subject

    from .agreement import MODES, ball, compare

    camera = ring_cameras(1, options.size)["cam00"]
    table = Table("body", "light", *MODES, "noise", "interreflection", "its energy", title="PSNR inside, dB")
    rows: list[dict[str, Any]] = []
    strips: list[Any] = []
    with Progress() as progress:
        progress.phase("dressing")
        dressed = dress(subject(options.subject), options.step)
        motion = dance(dressed.body.skeleton)
        if not 0 <= options.frame < motion.frame_count:
            raise InputError("--frame", expected=f"below {motion.frame_count}", got=options.frame)
        person = Wearer(dressed, motion, [options.frame]).surface(options.frame)
        for name, surface in (("ball", ball()), ("person", person)):
            progress.phase(f"{name}: fitting visibility, rendering")
            for result in compare(name, surface, camera, options.samples, options.lights, options.material):
                row = {**result.row, "variant": variant, "machine": machine()}
                ours = [f"{row[mode]['psnr_inside']:.1f} ({row[mode]['energy'] - 1:+.1%})" for mode in MODES]
                more = (f"{row['noise_psnr']:.1f}", f"{row['interreflection_psnr']:.1f}")
                table.add_row(name, row["light"], *ours, *more, f"{row['interreflection_energy']:+.1%}")
                rows.append(row)
                strips.append(result.strip())
                progress.update(len(rows), step=row["light"])
    write_json(options.json, rows)
    if options.sheet is not None:
        half = len(strips) // 2
        sheet = np.concatenate([np.concatenate(part) for part in (strips[:half], strips[half:])], axis=1)
        write_image(options.sheet, to_bytes(sheet))
    Console().print(table)
