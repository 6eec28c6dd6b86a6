"""``rnd-bench study filmed``: avatars of videos alone, scored on images that no video showed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from rnd_bench.lifter.pose2sim import SCORED
from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.capture.format import Split
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import output_file, output_folder, write_json
from rnd_runtime.playback.doctor import machine
from rnd_trainer.config import TrainConfig, preset, resized
from rnd_trainer.estimating.own_video import import_video
from rnd_trainer.evaluation.held_out import score
from rnd_trainer.evaluation.held_out_poses import fit_held_out
from rnd_trainer.importing.options import ImportOptions
from rnd_trainer.losses.perceptual import Perceptual, load_lpips
from rnd_trainer.model.checkpoint import load_checkpoint

from .film_truth import exact_poses, in_capture_of, other_cameras, wham_like
from .trainings import train
from .variants import VARIANTS, StudyRow, chosen
from .video_options import Filmed

SPLITS: tuple[Split, ...] = ("novel_pose", "novel_view")
FIGURES = ("psnr", "psnr_person", "lpips", "psnr_box", "lpips_box", "outline_px")
_REFINED = {"refine_poses": True}
METHODS = (
    StudyRow("ours", "poses refined in training", None, {}, _REFINED),
    next(row for row in VARIANTS if row.name == "LBS, plain colour"),
)
EXACT = StudyRow("exact poses", "the true poses instead of estimated ones", "ours")
WHAM = StudyRow("WHAM-like noise", "on the estimated poses, none refined; of one camera", "ours")
ROWS = "rows.json"  # in the folder of a run


@dataclass(frozen=True, eq=False)
class Film:
    """A video's capture, and what its avatar is scored on.

    Attributes:
        capture: as imported.
        scored: what is scored, in exact poses where ``exact`` is given; else in the poses of the training, and again
            after a fit of these to the scored images.
        exact: ``capture`` in the true poses, where they are known.
    """

    name: str
    capture: Capture
    scored: Capture
    exact: Capture | None = None

    def methods(self, wanted: Sequence[StudyRow]) -> list[StudyRow]:
        """Those of ``wanted`` that are for this film: exact poses where there are some, noise in one real film."""
        here = {EXACT.name: self.exact is not None, WHAM.name: self.name == SCORED[0]}
        return [method for method in wanted if here.get(method.name, True)]


def run(options: Filmed) -> None:
    """Import, train, score; print the table, write the rows."""
    out = output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    if (options.capture is None) != (options.video is None):
        raise InputError("--capture and --video", expected="both or neither", got="one")
    wanted = chosen((*METHODS, EXACT, WHAM), options.methods)
    config = resized(preset("quick"), options.gaussians, options.steps)
    config = replace(config, image_scale=options.image_scale, unseen_fraction=0.0, hold_out=options.hold_out)
    perceptual = load_lpips(options.perceptual_weights)
    judge = load_lpips(options.judge_weights) or perceptual
    rows: list[dict[str, Any]] = []
    with Progress() as progress:
        for film in _films(options, out, progress):
            for method in film.methods(wanted):
                progress.phase(f"{film.name}: {method.name}", 1)
                rows += _rows(film, method, config, out, (perceptual, judge), progress.update)
    if options.json is not None:
        write_json(options.json, {"machine": machine(), "rows": rows})
    table = Table("film", "method", "split", "poses", "frames", *FIGURES)
    for row in rows:
        figures = (f"{row[figure]:.4g}" if figure in row else "" for figure in FIGURES)
        table.add_row(row["film"], row["method"], row["split"], row["poses"], str(row["frames"]), *figures)
    Console(width=140, soft_wrap=True).print(table)


def _films(options: Filmed, out: Path, progress: Progress) -> Iterator[Film]:
    """Import the videos, one after another."""

    def imported(video: Path, name: str, **given: Any) -> Capture:
        folder = out / name / "capture"
        if not (folder / "capture.json").exists():
            on_progress = lambda phase, done, total: progress.at(f"{name}: {phase}", done, total)  # noqa: E731
            import_video(video, folder, ImportOptions(**given), on_progress=on_progress)
        return load_capture(folder)

    if options.capture is not None and options.video is not None:
        truth = load_capture(options.capture)
        K = truth.cameras[truth.split("train")[0].camera].K
        lens = tuple(map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
        body = str(truth.folder / "body.npz")
        capture = imported(options.video, "rendered", body=body, intrinsics=lens)
        capture = replace(
            capture, frames=tuple(msgspec.structs.replace(frame, split="train") for frame in capture.frames)
        )
        scored = in_capture_of(truth, capture, ("train",) if options.hold_out else SPLITS)
        yield Film("rendered", capture, scored, exact_poses(truth, capture))
    if options.real is not None:
        progress.phase("real cameras: landmarks")
        for name, view in other_cameras(options.real, out):
            capture = imported(view.video, name, intrinsics=view.intrinsics, distortion=view.distortion)
            yield Film(name, capture, view.scored(capture, out / name / "seen"))
    if options.clip is not None:
        capture = imported(options.clip, options.clip.stem)
        yield Film(options.clip.stem, capture, capture)


def _rows(
    film: Film,
    method: StudyRow,
    base: TrainConfig,
    out: Path,
    networks: tuple[Perceptual | None, Perceptual | None],
    on_share: Callable[[float], None],
) -> list[dict[str, Any]]:
    """Train, score; a run that was scored before is not done again."""
    slug = method.name.replace(",", "").replace(" ", "_").lower()
    folder = out / film.name / slug
    if (folder / ROWS).exists():
        found: list[dict[str, Any]] = json.loads((folder / ROWS).read_text(encoding="utf-8"))
        return found
    config = replace(base, model=dataclasses.replace(base.model, **method.model), **method.train)
    capture = film.exact if method is EXACT and film.exact is not None else film.capture
    capture = wham_like(capture) if method is WHAM else capture
    training = train(capture, config, folder, networks[0], on_share=on_share)
    checkpoint = load_checkpoint(folder / "avatar.ckpt")
    poses = {"exact": film.scored}
    if film.exact is None:
        scored = replace(film.scored, motion=training.motion())
        fitted = replace(scored, motion=fit_held_out(checkpoint, scored, SPLITS))
        poses = {"estimated": scored, "fitted": fitted}
    rows = []
    for which, shown in poses.items():
        strips = folder / f"strips_{which}"
        found = score(checkpoint, shown, method=method.name, perceptual=networks[1], strips=strips)
        rows += [{"film": film.name, "poses": which, **row} for row in found]
    write_json(folder / ROWS, rows)
    return rows
