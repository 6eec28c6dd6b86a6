"""rnd-stage: render a coded person on a light stage."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rnd_runtime.cli.command import finish, log, option, parse, run_command
from rnd_runtime.cli.jobs import On, run_jobs, workers
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.errors import InputError, refuse_changed

from .film.plan import Recipe
from .variants import Variant, need_extra, use_variant

if TYPE_CHECKING:
    from .film.film import Production


@dataclass(frozen=True)
class StageOptions:
    """Render a coded person on a light stage: many views, many lights, and ground truth for every image.

    rnd-stage out/lumberjack --frames 20 --cameras 4 --size 256
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for the capture; existing images stay"""
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = field(default_factory=Recipe)
    subjects: Annotated[tuple[int, ...], option("N ...")] = ()
    """several people instead of --subject, each into OUT/subjectN"""
    shard: str = "0/1"
    """K/N: render only the instants K, K+N, K+2N …; the last shard to end writes capture.json"""
    variant: Variant = "auto"
    """Mitsuba's back end; auto takes LLVM where it works"""
    on: On = None
    """render people on N processes of this machine, or on the workers of a Dask scheduler (extra [dask])"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``rnd-stage``."""
    return run_command("rnd-stage", lambda: _stage_all(parse(StageOptions, "rnd-stage", arguments)))


def _stage_all(options: StageOptions) -> None:
    """Render each person, here or on workers."""
    each = [options]
    if options.subjects:
        refuse_changed(options.recipe, ["subject", "character"], "--subjects has the people")
        recipes = {f"subject{seed}": replace(options.recipe, subject=seed) for seed in dict.fromkeys(options.subjects)}
        each = [replace(options, out=options.out / name, recipe=recipe) for name, recipe in recipes.items()]
    if options.on is None:
        for one in each:
            stage(one)
        return
    need_extra()
    with workers(options.on) as client:
        run_jobs(client, stage, [(one,) for one in each], name="people")
    for one in each:
        finish(one.out)


def stage(options: StageOptions) -> None:
    """Render a shard, and write the manifest once all images exist."""
    need_extra()
    shard = parse_shard(options.shard)
    options.recipe.check()
    variant = use_variant(options.variant)
    from .film.film import prepare
    from .film.manifest import write_manifest

    with Progress() as progress:
        progress.phase("dressing")
        production = prepare(options.recipe, options.out)
        for note in production.motion.notes:
            log(note)
        seconds = _film(production, options, shard, progress)
    if write_manifest(production, options.out, variant, seconds):
        finish(options.out / "capture.json", production.title, then=f"rnd-train {options.out} --out runs/stage")
    else:
        log("this shard is done; others are missing, so there is no capture.json yet")


def _film(production: Production, options: StageOptions, shard: tuple[int, int], progress: Progress) -> float | None:
    """Render a shard; processor seconds per image, None if nothing was missing."""
    from .film.film import film
    from .film.plan import image_count, missing

    own = set(production.frames[shard[0] :: shard[1]])
    views = [view for view in production.views if view.frame in own]
    fresh = image_count([view for view in views if missing(options.out, view, production.recipe.visibility)])
    progress.phase("rendering", image_count(views))
    done = count(1)
    cpu_seconds = film(production, options.out, shard=shard, on_image=lambda name: progress.update(next(done)))
    return cpu_seconds / fresh if fresh else None


def parse_shard(text: str) -> tuple[int, int]:
    """ "K/N" as (K, N) with 0 ≤ K < N."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    part, parts = (int(match[1]), int(match[2])) if match else (0, 0)
    if part >= parts:
        raise InputError("--shard", expected="K/N with K from 0 to N - 1", got=text)
    return part, parts
