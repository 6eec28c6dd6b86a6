"""Studies on one capture: same steps, same seeds, and the spread of the seeds beside every gain.

``VARIANTS`` are the paper's ablations; ``CAUSES`` tell what holds the figures back: each takes one doubt away (true
light, true normals) or adds one (noisy poses, fewer Gaussians); ``LENGTHS`` what more steps would bring.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import earlier_rows, sha256_of, write_json
from rnd_trainer.config import TrainConfig, nodes_for
from rnd_trainer.evaluation.held_out import score
from rnd_trainer.losses.perceptual import Perceptual, networks_by_role, networks_sha256
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.training.data import check_true_normals, training_light
from rnd_trainer.training.pose_refinement import joint_error_degrees
from rnd_trainer.training.run import run
from rnd_trainer.training.state import STATE_FILE, read_state
from rnd_trainer.training.training import Step, Training

ROWS = "rows.json"
"""of one run, in its folder"""
MOTION = "motion"
"""of a row: the file of the poses that were scored in, and learned from unless the method says otherwise"""
CAPTURE = "capture_sha256"
"""of a row: the digest of capture.json, which has the pictures of every split"""
FEATURES = "consistency_sha256"
"""of a row: the network whose features L_gc compared in training"""
OLDER_LACK = (MOTION, CAPTURE, FEATURES)
ELSEWHERE = "another folder for RUN, or delete this one"
POSE_SECONDS = 0.3 / 9
"""between two poses of a window: d poses span (d − 1) of these, so that the ablation of d is one of memory"""
NOISY_MOTION = "motion_noisy.npz"
"""beside a capture's exact motion"""
MEANS = ("psnr", "ssim", "lpips", "psnr_n")
"""figures whose means a summary has"""
TIMED = 20
"""evaluations of the motion encoder whose median is reported"""


@dataclass(frozen=True)
class StudyRow:
    """One row of the table: what is switched, beside which row it is to be read, and on which split it should show.

    ``model`` and ``train`` are the fields of the configuration that differ from ours; ``noisy`` trains on the
    capture's ``motion_noisy.npz`` and scores with the exact poses; ``length`` times as many steps are trained.
    """

    name: str
    what: str
    beside: str | None
    model: dict[str, Any] = dataclasses.field(default_factory=dict)
    train: dict[str, Any] = dataclasses.field(default_factory=dict)
    noisy: bool = False
    length: float = 1.0


def _window(d: int) -> StudyRow:
    model = {"window_poses": d, "window_seconds": (d - 1) * POSE_SECONDS}
    return StudyRow(f"d = {d}", f"a window of {d} poses instead of 10", "ours", model)


_NO_GC = {"weight_consistency": 0.0}
VARIANTS = (
    StudyRow("ours", "everything, L_gc too", "+ D_W"),
    StudyRow(
        "LBS, plain colour",
        "template skinning and colours that no light changes: the core of 3DGS-Avatar and GauHuman",
        "ours",
        {"dynamic_skinning": False},
        {"light": "none", **_NO_GC},
    ),
    StudyRow("static skinning", "the template's weights, no L_gc", "ours", {"dynamic_skinning": False}, _NO_GC),
    StudyRow("+ D_W", "dynamic skinning, no L_gc", "static skinning", {}, _NO_GC),
    StudyRow(
        "+ unseen poses",
        "the third stage: edge lengths",
        "ours",
        {},
        {"unseen_fraction": TrainConfig().unseen_fraction},
    ),
    StudyRow("spatial only", "no temporal attention", "ours", {"motion_encoder": "spatial"}),
    *(_window(d) for d in (2, 5, 20, 30)),
    StudyRow("grey light", "a probe of one channel, as printed", "ours", {}, {"probe_channels": 1}),
    StudyRow("light from white", "no search for sky and suns", "ours", {}, {"light_search": False}),
    StudyRow("paper's visibility", "of the direction to the camera", "ours", {"visibility": "paper"}),
    StudyRow("no visibility", "no shadows", "ours", {"visibility": "none"}),
    StudyRow("mesh normals", "the template's normals for shading", "ours", {"learned_normals": False}),
)


def _gaussians(count: int) -> StudyRow:
    model = {"gaussians": count, "nodes": nodes_for(count)}
    return StudyRow(f"N = {count}", f"{count} Gaussians", "ours", model)


CAUSES = (
    StudyRow("ours", "everything learned, exact poses", None),
    StudyRow("true light", "the capture's own light map", "ours", {}, {"light": "capture"}),
    StudyRow("true normals", "exact normals instead of estimated ones", "ours", {}, {"normals": "true"}),
    StudyRow("noisy poses", "the capture's noisy poses", "ours", {}, {}, noisy=True),
    StudyRow("noisy poses, refined", "and corrected", "noisy poses", {}, {"refine_poses": True}, noisy=True),
    *(_gaussians(count) for count in (7_500, 15_000, 60_000, 120_000)),
)
LENGTHS = (
    StudyRow("ours", "the steps of the preset", None),
    *(
        StudyRow(name, f"{name} times the steps", "ours", length=length)
        for name, length in (("1/8", 1 / 8), ("1/4", 1 / 4), ("1/2", 1 / 2), ("5", 5.0))
    ),
)
STUDIES = {"ablations": VARIANTS, "causes": CAUSES, "lengths": LENGTHS}


def chosen(variants: Sequence[StudyRow], names: Sequence[str]) -> tuple[StudyRow, ...]:
    """Those of ``names``, in the study's order; all where none is named. Raises ``InputError`` for others."""
    known = [variant.name for variant in variants]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError("--variants", expected="some of " + ", ".join(known), got=", ".join(unknown))
    return tuple(variant for variant in variants if not names or variant.name in names)


def ablate(
    capture: Capture,
    base: TrainConfig,
    folder: Path,
    variants: Sequence[StudyRow],
    *,
    seeds: Sequence[int],
    perceptual: Perceptual | None,
    consistency: Perceptual | None = None,
    mode: str = "table+sun",
    on_run: Callable[[str, int, float, int], None],
) -> list[dict[str, Any]]:
    """Train and score every variant with every seed; rows as of rnd-eval with the encoder's cost added.

    They compare what pictures teach: the third stage is off but in the row that asks for it. Each run leaves
    ``rows.json`` in ``folder/NAME-SEED``, and is not done again where that exists. ``on_run`` is called with the
    variant's name, the seed, how many runs are done (that in hand by its share of steps) and how many there are.

    Raises ``InputError``, before anything is trained, where a run done or begun before is not of this study.
    """
    told = {MOTION: Path(capture.motion.source).name, CAPTURE: sha256_of(capture.file)}

    def same(config: TrainConfig) -> dict[str, Any]:
        """What rows of a run with ``config`` say of themselves."""
        return {
            "capture": capture.folder.resolve().name,
            "steps": config.steps,
            "gaussians": config.model.gaussians,
            "image_scale": config.image_scale,
            "shade": mode,
            "lpips_weights_sha256": None if perceptual is None else perceptual.sha256,
            FEATURES: networks_sha256(consistency or perceptual),
            **told,
        }

    rows: list[dict[str, Any]] = []
    jobs: list[tuple[StudyRow, int, TrainConfig, list[dict[str, Any]]]] = []
    for seed in seeds:
        for variant in variants:
            config = _config(base, variant, seed)
            place = _place(folder, variant, seed)
            found = _done_before(place, same(config))
            if (place / STATE_FILE).exists():
                begun = read_state(place / STATE_FILE)
                networks = networks_by_role(perceptual, consistency or perceptual)
                begun.refuse_other(config, networks, what="a run begun before", hint=ELSEWHERE)
                learned = told | ({MOTION: NOISY_MOTION} if variant.noisy else {})
                _refuse_others(begun.header, learned, "begun", place / STATE_FILE)
            jobs.append((variant, seed, config, found))
    for done, (variant, seed, config, found) in enumerate(jobs):

        def tell(share: float, name: str = variant.name, seed: int = seed, before: int = done) -> None:
            on_run(name, seed, before + share, len(jobs))

        tell(0.0)
        if not found:
            place = _place(folder, variant, seed)
            seen = _noisy(capture) if variant.noisy else capture
            extra = _train(seen, config, place, perceptual, consistency, capture, tell)
            checkpoint = load_checkpoint(place / "avatar.ckpt")
            scored = score(checkpoint, capture, method=variant.name, mode=mode, perceptual=perceptual)
            cost = encoder_cost(checkpoint.model)
            write_json(place / ROWS, [row | cost | extra for row in scored])
            found = _rows(place)
        rows += found
    return rows


def check_needs(variants: Iterable[StudyRow], capture: Capture) -> None:
    """Raise ``InputError`` where ``capture`` lacks what one of ``variants`` learns from."""
    for variant in variants:
        if variant.noisy:
            _noisy(capture)
        if variant.train.get("light") == "capture":
            training_light(capture, f"variant {variant.name!r}")
        if variant.train.get("normals") == "true":
            check_true_normals(capture, capture.split("train"), f"variant {variant.name!r}")


def _config(base: TrainConfig, variant: StudyRow, seed: int) -> TrainConfig:
    model = dataclasses.replace(base.model, **variant.model)
    steps = max(round(base.steps * variant.length), 1)
    changed = {"steps": steps, "unseen_fraction": 0.0, **variant.train}
    return dataclasses.replace(base, model=model, seed=seed, **changed)


def _noisy(capture: Capture) -> Capture:
    return load_capture(capture.file, motion_file=NOISY_MOTION)


def _done_before(place: Path, same: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a run that is done, none of one that is not.

    Raises ``InputError`` where they do not say ``same``: they would be compared as if they were of this study.
    """
    rows = _rows(place)
    if rows:
        _refuse_others(rows[0], same, "done", place / ROWS)
    return rows


def _refuse_others(before: dict[str, Any], same: dict[str, Any], stage: str, file: Path) -> None:
    """Raise ``InputError`` where a run that was begun or done does not say ``same``."""
    for name, value in same.items():
        got = before.get(name, value if name in OLDER_LACK else None)
        if got != value:
            raise InputError(f"{name} of a run {stage} before", expected=value, got=got, file=file, hint=ELSEWHERE)


def _rows(place: Path) -> list[dict[str, Any]]:
    file = place / ROWS
    try:
        return earlier_rows(file, what="rows of a study", names=("method", "split", "seed", "psnr"))
    except InputError as error:
        what, expected = "a run done before", error.expected
        raise InputError(what, expected=expected, got=error.got, file=file, hint=ELSEWHERE) from error


def time_encoders(
    rows: list[dict[str, Any]], folder: Path, variants: Sequence[StudyRow], seed: int
) -> list[dict[str, Any]]:
    """``rows`` with every variant's ``encoder_cost`` measured now, one after the other, on its avatar of ``seed``.

    Those of the trainings were taken hours apart, beside whatever else ran then.
    """
    costs = {
        variant.name: encoder_cost(load_checkpoint(_place(folder, variant, seed) / "avatar.ckpt").model)
        for variant in variants
    }
    return [row | costs[row["method"]] for row in rows]


def summarise(
    rows: Sequence[dict[str, Any]], variants: Sequence[StudyRow], figure: str = "psnr"
) -> list[dict[str, Any]]:
    """One row for each variant: mean and spread (standard deviation) over seeds of ``figure`` on every split.

    ``gain`` is the mean over seeds of the difference to the variant that it is to be read beside, seed by seed,
    and ``shows`` whether it exceeds the spread of those differences; None where one seed has no spread. Beside them
    stand the means of ``MEANS``.
    """
    by_key = {(row["method"], row["split"], row["seed"]): row for row in rows}
    splits = list(dict.fromkeys(row["split"] for row in rows))
    seeds = sorted({row["seed"] for row in rows})
    table = []
    for variant in variants:
        cells: dict[str, Any] = {"method": variant.name, "what": variant.what, "beside": variant.beside}
        for split in splits:
            own = {s: by_key[variant.name, split, s][figure] for s in seeds if (variant.name, split, s) in by_key}
            if not own:
                continue
            cells[split] = {"mean": statistics.fmean(own.values()), "spread": _spread(list(own.values()))}
            scored = [by_key[variant.name, split, s] for s in own]
            cells[split] |= _means(scored, (name for name in MEANS if name != figure))
            gains = [
                value - by_key[variant.beside, split, s][figure]
                for s, value in own.items()
                if variant.beside and (variant.beside, split, s) in by_key
            ]
            if gains:
                spread = _spread(gains)
                gain = statistics.fmean(gains)
                cells[split] |= {"gain": gain, "gain_spread": spread}
                cells[split] |= {"shows": None if spread is None else abs(gain) > spread}
        costs = [row for row in rows if row["method"] == variant.name]
        if costs:
            cells["encoder_gflop"] = costs[0]["encoder_gflop"]
            cells["encoder_ms"] = statistics.median(row["encoder_ms"] for row in costs)
            cells |= _means(costs, ("minutes", "pose_error_before_deg", "pose_error_after_deg"))
        table.append(cells)
    return table


@torch.no_grad()
def encoder_cost(model: AvatarModel) -> dict[str, float]:
    """FLOPs (2 per multiply-add) and median milliseconds in torch of the motion encoder D_W at its nodes."""
    if not model.config.dynamic_skinning:
        return {"encoder_gflop": 0.0, "encoder_ms": 0.0}
    joints = model.log_weights.shape[1] - 1
    window, velocity = torch.zeros(model.config.window_poses, joints, 6), torch.zeros(joints, 3)
    encoded = model.encoded_nodes()
    with FlopCounterMode(display=False) as counter:
        model.skinning(encoded, window, velocity)
    times = []
    for _ in range(TIMED):
        started = time.perf_counter()
        model.skinning(encoded, window, velocity)
        times.append(1e3 * (time.perf_counter() - started))
    return {"encoder_gflop": counter.get_total_flops() / 1e9, "encoder_ms": statistics.median(times)}


def _train(
    seen: Capture,
    config: TrainConfig,
    place: Path,
    perceptual: Perceptual | None,
    consistency: Perceptual | None,
    truth: Capture,
    on_share: Callable[[float], None],
) -> dict[str, float]:
    """Train on ``seen``; what the poses were off by before and after, in degrees, where they were not exact."""
    place.mkdir(parents=True, exist_ok=True)
    training = Training(seen, config, perceptual, consistency=consistency)
    if (place / STATE_FILE).exists():
        training.resume(place / STATE_FILE)
    effort = training.schedule.effort

    def on_step(step: Step) -> None:
        on_share(effort(step.index + 1) / effort(training.schedule.total))

    if run(training, place, on_step=on_step, on_preview=lambda: None):
        raise KeyboardInterrupt
    if seen is truth:
        return {}
    frames = [view.frame.frame for view in training.views]
    return {
        "pose_error_before_deg": joint_error_degrees(seen.motion, truth.motion, frames),
        "pose_error_after_deg": joint_error_degrees(training.motion(), truth.motion, frames),
    }


def _means(rows: Sequence[dict[str, Any]], names: Iterable[str]) -> dict[str, float]:
    """Of the columns ``names`` that all ``rows`` have a number in."""
    return {
        name: statistics.fmean(row[name] for row in rows)
        for name in names
        if all(row.get(name) is not None for row in rows)
    }


def _spread(values: list[float]) -> float | None:
    """None of a single value: JSON has no NaN."""
    return statistics.stdev(values) if len(values) > 1 else None


def _place(folder: Path, variant: StudyRow, seed: int) -> Path:
    return folder / f"{_slug(variant.name)}-{seed}"


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name).strip("_").lower()
