"""People of the light stage: render every subject, train on one camera's white light, score the rest; resumes."""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.files import write_json
from rnd_runtime.core.signals import at_end
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.light import REC709_LUMINANCE
from rnd_stage.film.film import film, prepare, recipe_for
from rnd_stage.film.manifest import write_manifest
from rnd_stage.film.plan import image_count, missing
from rnd_stage.people import subjects
from rnd_trainer.config import preset, resized
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.training.lighting.skin import TONES

from .options import PeopleSizes
from .people_sheet import write_people_sheet
from .summary import summarise
from .trainings import ablate, folder_of
from .variants import StudyRow

COST_FILE = "cost.json"
FIGURES = ("psnr", "psnr_person", "ssim", "lpips", "psnr_n", "normal_deg", "psnr_albedo", "light_hue_de", "flicker")
"""metrics of rnd-eval and ``light_hue_de``, averaged over the subjects"""
SKIN_KNOWN = StudyRow("skin known", "--skin of each person's type", "ours")


def film_subjects(sizes: PeopleSizes, folder: Path, variant: str, on_image: Callable[[int, int], None]) -> None:
    """Render the missing images of every subject; ``on_image`` is called with the numbers of images done and of all."""
    done, total = 0, None
    for subject in sizes.seeds_of_people:
        out = folder / f"subject{subject}"
        if (out / "capture.json").exists():
            recipe_for(sizes.recipe(subject), out)
            continue
        production = prepare(sizes.recipe(subject), out)
        fresh = [view for view in production.views if missing(out, view, False)]
        total = sizes.subjects * image_count(production.views) if total is None else total

        def count(name: str, expected: int = total) -> None:
            nonlocal done
            done += 1
            on_image(done, expected)

        def images(fresh: list[Any] = fresh, out: Path = out) -> int:
            return image_count([view for view in fresh if not missing(out, view, False)])

        record = _Cost(out, {"variant": variant, "machine": machine()}, images)
        with at_end(record.write):  # a signal that ends the process runs no finally
            try:
                film(production, out, on_image=count)
            finally:
                cost = record.write()
        write_manifest(production, out, variant, cost["cpu_seconds"] / max(cost["images"], 1))


class _Cost:
    """The cost of rendering one subject: that of earlier runs, and of this one from now on."""

    def __init__(self, folder: Path, about: dict[str, Any], images: Callable[[], int]) -> None:
        self.file, self.about, self.images = folder / COST_FILE, about, images
        self.before = json.loads(self.file.read_text(encoding="utf-8")) if self.file.exists() else {}
        self.started, self.started_cpu = time.perf_counter(), time.process_time()

    def write(self) -> dict[str, Any]:
        """Write the cost so far, at any moment and from any thread."""
        spent = {
            "images": self.images(),
            "seconds": time.perf_counter() - self.started,
            "cpu_seconds": time.process_time() - self.started_cpu,
        }
        cost = {name: value + self.before.get(name, 0) for name, value in spent.items()} | self.about
        write_json(self.file, cost)
        return cost


def run_study(
    sizes: PeopleSizes,
    folder: Path,
    variants: Sequence[StudyRow],
    *,
    perceptual: Perceptual | None,
    judge: Perceptual | None = None,
    on_run: Callable[[str, float, int], None],
) -> dict[str, Any]:
    """Train and score every variant on every rendered subject: rows, summaries and cost.

    ``on_run`` is called with the current training's name, the number of trainings done (a fraction) and of all.
    """
    started = time.perf_counter()
    base = resized(preset("quick"), sizes.gaussians, sizes.steps)
    total = sizes.subjects * sizes.seeds * len(variants)
    rows: list[dict[str, Any]] = []
    summaries: dict[str, list[dict[str, Any]]] = {}
    done = 0
    for subject in sizes.seeds_of_people:
        capture = load_capture(folder / f"subject{subject}")

        def on_training(
            name: str, seed: int, of_subject: float, _: int, subject: int = subject, before: int = done
        ) -> None:
            on_run(f"subject {subject}, {name}, seed {seed}", before + of_subject, total)

        own = ablate(
            capture,
            base,
            _runs(sizes, folder, subject),
            [_told(variant, subject) for variant in variants],
            seeds=range(sizes.seeds),
            perceptual=perceptual,
            judge=judge,
            on_run=on_training,
        )
        done += sizes.seeds * len(variants)
        light = capture.split("train")[0].light
        rows += [{**row, "subject": subject, "train_light": light} for row in own]
        summaries[f"subject{subject}"] = summarise(own, variants)
    return {
        "options": dataclasses.asdict(sizes),
        "means": means(rows),
        "summary": summaries,
        "cost": _cost(folder, sizes, rows, time.perf_counter() - started),
        "rows": rows,
    }


def _told(variant: StudyRow, subject: int) -> StudyRow:
    """``SKIN_KNOWN`` with the type of skin that reflects most nearly as the ``subject``'s does; others as they are."""
    if variant is not SKIN_KNOWN:
        return variant
    reflected = float(np.dot(subjects.subject(subject).palette.skin, REC709_LUMINANCE))
    kind = 1 + int(np.argmin(np.abs(np.log(np.divide(TONES, reflected)))))
    return dataclasses.replace(variant, train={"skin": kind})


def _runs(sizes: PeopleSizes, folder: Path, subject: int) -> Path:
    return folder / f"runs{subject}-{sizes.steps}-{sizes.gaussians}"


def write_sheet(sizes: PeopleSizes, folder: Path, variant: StudyRow, file: Path) -> None:
    """Write ``people_sheet`` of the first training of every subject with ``variant``."""
    people = []
    for subject in sizes.seeds_of_people:
        trained = folder_of(_runs(sizes, folder, subject), variant, 0) / "avatar.ckpt"
        out = folder / f"subject{subject}"
        people.append((load_checkpoint(trained), load_capture(out), prepare(sizes.recipe(subject), out)))
    write_people_sheet(file, people)


def looks_before(file: Path) -> int:
    """How often the results in ``file`` were scored before: a test subject is looked at once."""
    return int(json.loads(file.read_text(encoding="utf-8")).get("looks", 1)) if file.exists() else 0


def means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for every method and split: FIGURES as means over the subjects, of each the mean over its seeds.

    ``psnr_spread`` is the standard deviation over a subject's seeds, in the mean, ``psnr_subjects`` that over the
    subjects; a figure without rows is None.
    """
    table = []
    for method, split in dict.fromkeys((row["method"], row["split"]) for row in rows):
        by_subject: dict[int, list[dict[str, Any]]] = {}
        for row in rows:
            if (row["method"], row["split"]) == (method, split):
                by_subject.setdefault(row["subject"], []).append(row)
        line: dict[str, Any] = {"method": method, "split": split, "subjects": len(by_subject)}
        for figure in FIGURES:
            each = [[row[figure] for row in of if row.get(figure) is not None] for of in by_subject.values()]
            each = [values for values in each if values]
            line[figure] = statistics.fmean(map(statistics.fmean, each)) if each else None
        psnr = [[row["psnr"] for row in of] for of in by_subject.values()]
        line["psnr_subjects"] = statistics.stdev(map(statistics.fmean, psnr)) if len(psnr) > 1 else None
        spreads = [statistics.stdev(values) for values in psnr if len(values) > 1]
        line["psnr_spread"] = statistics.fmean(spreads) if spreads else None
        table.append(line)
    return table


def _cost(folder: Path, sizes: PeopleSizes, rows: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Measured seconds per image, and hours of rendering and training; None where rnd-stage recorded no cost."""
    files = [folder / f"subject{subject}" / COST_FILE for subject in sizes.seeds_of_people]
    filmed = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()]
    images, filming, cpu = (sum(f[key] for f in filmed) for key in ("images", "seconds", "cpu_seconds"))
    trainings = {(row["subject"], row["method"], row["seed"]): row["minutes"] for row in rows}
    return {
        "seconds_per_image": filming / images if images else None,
        "cpu_seconds_per_image": cpu / images if images else None,
        "images": images,
        "hours_filming": filming / 3600,
        "hours_training": sum(minutes or 0 for minutes in trainings.values()) / 60,
        "hours_this_call": seconds / 3600,
        "variant": filmed[0]["variant"] if filmed else None,
        "machine": machine(),
    }
