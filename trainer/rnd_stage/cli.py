"""rnd-stage: the command around the light stage: filming, and the two studies that stand on it."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError, parse_options, run_command
from rnd_runtime.core.files import output_file, output_folder, write_json
from rnd_runtime.core.images import to_bytes, write_image
from rnd_stage.film.plan import BenchmarkOptions, Recipe, check_step

from .variants import Variant, need_extra, use_variant

_DESCRIPTION = """Film a coded person on a light stage: many views, many lights, the truth beside every picture.

Instead of OUT, "agreement JSON" compares our renderer with Mitsuba, "benchmark OUT" films four people and trains."""


@dataclass(frozen=True)
class StageOptions:
    """Film a coded person on a light stage: many views, many lights, and the truth beside every picture."""

    out: Annotated[Path, tyro.conf.Positional]
    """folder for the capture; what is there already is kept"""
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = field(default_factory=Recipe)
    shard: str = "0/1"
    """K/N: film only the instants K, K+N, K+2N …; whoever finishes last writes capture.json"""
    variant: Variant = "auto"
    """Mitsuba's back end; auto takes LLVM where it works"""


@dataclass(frozen=True)
class Agreement:
    """Our renderer with true attributes of a ball and of a person against Mitsuba, under every light of the stage."""

    json: Annotated[Path, tyro.conf.Positional]
    """write the rows here"""
    subject: int = 0
    """seed of the person"""
    frame: int = 40
    """of the dance"""
    size: int = 256
    """pixels, square"""
    samples: int = 128
    """Mitsuba's paths a pixel; what noise they leave stands in every row"""
    lights: tuple[str, ...] = ()
    """names of the lights; none named: white and all eight coloured ones"""
    picture: Path | None = None
    """write ours, Mitsuba's direct light, four times their difference and interreflection, a row for each light"""
    step: float = 0.006
    """metres between the person's vertices, and Gaussians"""
    variant: Variant = "auto"
    """Mitsuba's back end"""


@dataclass(frozen=True)
class Benchmark:
    """Film four people, train on one camera's white light, score novel views, poses and lights; continues itself."""

    out: Annotated[Path, tyro.conf.Positional]
    """folder for captures and trainings"""
    json: Path | None = None
    """write summary, cost and rows here"""
    perceptual_weights: Path | None = None
    """adds LPIPS to the metrics and to the training, as in rnd-train"""
    film_only: bool = False
    """stop when all is filmed"""
    sizes: Annotated[BenchmarkOptions, tyro.conf.arg(name="")] = field(default_factory=BenchmarkOptions)
    variant: Variant = "auto"
    """Mitsuba's back end"""


def main() -> None:
    """Entry point of ``rnd-stage``: ``rnd-stage OUT``, ``rnd-stage agreement JSON``, ``rnd-stage benchmark OUT``."""
    name, words = "rnd-stage", sys.argv[1:]

    def command() -> None:
        if words[:1] == ["agreement"]:
            _agreement(parse_options(lambda: tyro.cli(Agreement, prog=f"{name} agreement", args=words[1:])))
        elif words[:1] == ["benchmark"]:
            _benchmark(parse_options(lambda: tyro.cli(Benchmark, prog=f"{name} benchmark", args=words[1:])))
        else:
            _stage(parse_options(lambda: tyro.cli(StageOptions, prog=name, description=_DESCRIPTION)))

    sys.exit(run_command(name, command))


def _stage(options: StageOptions) -> None:
    need_extra()
    shard = parse_shard(options.shard)
    options.recipe.check()
    variant = use_variant(options.variant)
    from rich.console import Console

    from rnd_stage.film.film import prepare
    from rnd_stage.film.manifest import finish

    console = Console(stderr=True)
    with console.status("dressing"):
        production = prepare(options.recipe, options.out)
    for note in production.motion.notes:
        console.print(f"rnd-stage: {note}", markup=False, emoji=False, soft_wrap=True)
    seconds = _film_with_progress(production, options, shard, console)
    if finish(production, options.out, variant, seconds):
        console.print(f"{options.out / 'capture.json'}: {production.title}", markup=False, emoji=False, soft_wrap=True)
    else:
        console.print("rnd-stage: this shard is filmed; others are missing, so there is no capture.json yet")


def _film_with_progress(production, options: StageOptions, shard: tuple[int, int], console) -> float | None:
    """Film a shard with a progress bar; processor seconds per picture, None where all was there."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from rnd_stage.film.film import film
    from rnd_stage.film.plan import missing, picture_count

    own = set(production.frames[shard[0] :: shard[1]])
    shots = [shot for shot in production.shots if shot.frame in own]
    fresh = picture_count([s for s in shots if missing(options.out, s, production.recipe.visibility)])
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, speed_estimate_period=120) as progress:
        task = progress.add_task("filming", total=picture_count(shots))
        spent = film(production, options.out, shard=shard, on_picture=lambda name: progress.advance(task))
    return spent.cpu_seconds / fresh if fresh else None


def parse_shard(text: str) -> tuple[int, int]:
    """ "K/N" as (K, N) with 0 ≤ K < N.

    Raises:
        InputError: anything else.
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    part, parts = (int(match[1]), int(match[2])) if match else (0, 0)
    if part >= parts:
        raise InputError("--shard", expected="K/N with K from 0 to N - 1", got=text)
    return part, parts


def _agreement(options: Agreement) -> None:
    need_extra()
    if options.size < 16 or options.samples < 2:
        raise InputError("--size, --samples", expected="at least 16, 2", got=f"{options.size}, {options.samples}")
    check_step(options.step)
    if options.picture is not None and options.picture.suffix.lower() != ".png":
        raise InputError("--picture", expected="a .png", got=options.picture.name)
    for file in filter(None, (options.json, options.picture)):
        output_file(file)
    variant = use_variant(options.variant)
    from rich.console import Console
    from rich.table import Table

    from rnd_runtime.playback.doctor import machine
    from rnd_stage.film.cameras import ring_cameras
    from rnd_stage.film.dances import dance
    from rnd_stage.people.dressing import Wearer, dress
    from rnd_stage.people.subjects import subject

    from .agreement import AgreementOptions, ball, compare

    settings = AgreementOptions(options.size, options.samples, lights=options.lights)
    camera = ring_cameras(1, options.size)["cam00"]
    chosen = subject(options.subject)
    table = Table("body", "light", *settings.modes, "noise", "interreflection", "its energy", title="PSNR inside, dB")
    rows: list[dict[str, Any]] = []
    strips: list[NDArray[np.float64]] = []
    with Console(stderr=True).status("dressing") as status:
        dressed = dress(chosen, options.step)
        motion = dance(dressed.body.skeleton)
        if not 0 <= options.frame < motion.frame_count:
            raise InputError("--frame", expected=f"below {motion.frame_count}", got=options.frame)
        person = Wearer(dressed, motion, [options.frame]).surface(options.frame)
        for name, surface in (("ball", ball()), ("person", person)):
            status.update(f"{name}: fitting visibility")
            for result in compare(name, surface, camera, settings):
                row = {**result.row, "variant": variant, "machine": machine()}
                ours = [f"{row[mode]['psnr_inside']:.1f} ({row[mode]['energy'] - 1:+.1%})" for mode in settings.modes]
                table.add_row(
                    name,
                    row["light"],
                    *ours,
                    f"{row['noise_psnr']:.1f}",
                    f"{row['interreflection_psnr']:.1f}",
                    f"{row['interreflection_energy']:+.1%}",
                )
                rows.append(row)
                strips.append(result.strip())
                status.update(f"{name}: {row['light']} is done")
    write_json(options.json, rows)
    if options.picture is not None:
        half = len(strips) // 2
        sheet = np.concatenate([np.concatenate(part) for part in (strips[:half], strips[half:])], axis=1)
        write_image(options.picture, to_bytes(sheet))
    Console().print(table)


def _benchmark(options: Benchmark) -> None:
    need_extra()
    settings = options.sizes
    settings.check()
    variant = use_variant(options.variant)
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from rnd_bench.studies.stage_people import FIGURES, film_subjects, run_benchmark
    from rnd_trainer.commands.eval import wide_console
    from rnd_trainer.losses.perceptual import load_lpips

    perceptual = load_lpips(options.perceptual_weights)
    output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    with Progress(console=Console(stderr=True), speed_estimate_period=600) as progress:
        filming = progress.add_task("filming", total=None)
        film_subjects(
            settings, options.out, variant, lambda done, total: progress.update(filming, completed=done, total=total)
        )
        if options.film_only:
            return
        training = progress.add_task("training", total=None)
        result = run_benchmark(
            settings,
            options.out,
            perceptual=perceptual,
            on_run=lambda what, done, total: progress.update(training, description=what, completed=done, total=total),
        )
    if options.json is not None:
        write_json(options.json, result)
    table = Table("method", "split", *FIGURES, title=f"means of {settings.subjects} subjects")
    for line in result["means"]:
        cells = ("" if line[figure] is None else f"{line[figure]:.4g}" for figure in FIGURES)
        table.add_row(line["method"], line["split"], *cells)
    wide_console().print(table)
