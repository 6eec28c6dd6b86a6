"""The multi-view, multi-illumination benchmark: film every subject, train on one camera's white light, score the rest.

Everything is kept and nothing is done twice: pictures, trainings and rows lie in one folder.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rnd_runtime.capture import load_capture
from rnd_runtime.doctor import machine
from rnd_runtime.files import atomic_path
from rnd_trainer.ablate import VARIANTS, ablate, summarise
from rnd_trainer.config import preset, resized
from rnd_trainer.perceptual import Perceptual

from .film import film, keep_recipe, prepare
from .manifest import finish
from .plan import BenchmarkOptions, missing, picture_count

SUBJECTS = (0, 1, 2, 3)
SEEDS = (0, 1, 2)
"""of the subject that is trained with more than one"""
METHODS = ("ours", "static skinning", "LBS, plain colour")
COST_FILE = "cost.json"


def film_subjects(
    options: BenchmarkOptions, folder: Path, variant: str, on_picture: Callable[[int, int], None]
) -> None:
    """Film what is missing of every subject; ``on_picture`` is told how many pictures there are and will be."""
    done, total = 0, None
    for subject in SUBJECTS:
        place = folder / f"subject{subject}"
        keep_recipe(options.recipe(subject), place)
        if (place / "capture.json").exists():
            continue
        production = prepare(options.recipe(subject), place)
        fresh = [shot for shot in production.shots if missing(place, shot, False)]
        total = len(SUBJECTS) * picture_count(production.shots) if total is None else total

        def count(name: str, expected: int = total) -> None:
            nonlocal done
            done += 1
            on_picture(done, expected)

        seconds = film(production, place, on_picture=count)
        pictures = picture_count(fresh)
        cost = {"pictures": pictures, "seconds": seconds, "variant": variant, "machine": machine()}
        with atomic_path(place / COST_FILE) as temporary:
            temporary.write_text(json.dumps(cost, indent=1) + "\n", encoding="utf-8")
        finish(production, place, variant, seconds / max(pictures, 1))


def run_benchmark(
    options: BenchmarkOptions,
    folder: Path,
    *,
    perceptual: Perceptual | None,
    on_run: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Train and score every method on every filmed subject: rows, their summary, and what it all cost.

    ``on_run`` is called with a line on what is being trained, how many trainings are done and how many there are.
    """
    started = time.perf_counter()
    base = resized(preset("quick"), options.gaussians, options.steps)
    variants = [variant for variant in VARIANTS if variant.name in METHODS]
    total = (len(SUBJECTS) - 1 + len(SEEDS)) * len(variants)
    rows: list[dict[str, Any]] = []
    summaries: dict[str, list[dict[str, Any]]] = {}
    done = 0
    for subject in SUBJECTS:
        capture = load_capture(folder / f"subject{subject}")
        seeds = SEEDS if subject == SUBJECTS[0] else SEEDS[:1]

        def tell(
            name: str, seed: int, of_subject: int, _: int, subject: int = subject, before: int = done
        ) -> None:
            on_run(f"subject {subject}, {name}, seed {seed}", before + of_subject, total)

        own = ablate(
            capture,
            base,
            folder / f"runs{subject}-{options.steps}-{options.gaussians}",
            variants,
            seeds=seeds,
            perceptual=perceptual,
            on_run=tell,
        )
        done += len(seeds) * len(variants)
        rows += [{**row, "subject": subject} for row in own]
        summaries[f"subject{subject}"] = summarise(own, variants)
    return {
        "options": dataclasses.asdict(options),
        "summary": summaries,
        "cost": _cost(folder, rows, time.perf_counter() - started),
        "rows": rows,
    }


def means(rows: list[dict[str, Any]], figure: str) -> list[tuple[str, dict[str, float]]]:
    """For every method the mean of ``figure`` over the subjects, by split; seeds of one subject count as one."""
    table = []
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = {}
        for split in dict.fromkeys(row["split"] for row in rows):
            by_subject: dict[int, list[float]] = {}
            for row in rows:
                if row["method"] == method and row["split"] == split and row.get(figure) is not None:
                    by_subject.setdefault(row["subject"], []).append(row[figure])
            if by_subject:
                each = [sum(values) / len(values) for values in by_subject.values()]
                cells[split] = sum(each) / len(each)
        table.append((method, cells))
    return table


def _cost(folder: Path, rows: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Seconds a picture and hours of filming and training, as they were measured when it was done."""
    filmed = [json.loads((folder / f"subject{s}" / COST_FILE).read_text(encoding="utf-8")) for s in SUBJECTS]
    pictures, filming = sum(f["pictures"] for f in filmed), sum(f["seconds"] for f in filmed)
    trainings = {(row["subject"], row["method"], row["seed"]): row["minutes"] for row in rows}
    return {
        "seconds_per_picture": filming / max(pictures, 1),
        "pictures": pictures,
        "hours_filming": filming / 3600,
        "hours_training": sum(minutes or 0 for minutes in trainings.values()) / 60,
        "hours_this_call": seconds / 3600,
        "variant": filmed[0]["variant"],
        "machine": machine(),
    }
