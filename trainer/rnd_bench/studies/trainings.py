"""The trainings of a study on one capture, each run once and scored."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import earlier_rows, sha256_of, write_json
from rnd_runtime.motion.motion import Motion
from rnd_trainer.config import TrainConfig
from rnd_trainer.evaluation.held_out import score
from rnd_trainer.losses.perceptual import Perceptual, networks_by_role, networks_sha256
from rnd_trainer.model.checkpoint import Checkpoint, load_checkpoint
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.training.data import check_true_normals
from rnd_trainer.training.lighting.lights import capture_lights
from rnd_trainer.training.poses.refinement import joint_error_degrees
from rnd_trainer.training.run import run
from rnd_trainer.training.saving import resume_training
from rnd_trainer.training.state import STATE_FILE, read_state
from rnd_trainer.training.training import StepResult, Training

from .light_hue import hue_difference
from .variants import StudyRow

ROWS = "rows.json"  # in the folder of a run
MOTION = "motion"  # column: the motion file of the scored poses
CAPTURE = "capture_sha256"  # column: digest of capture.json
FEATURES = "consistency_sha256"  # column: the network of L_gc
ELSEWHERE = "another folder for RUN, or delete this one"
NOISY_MOTION = "motion_noisy.npz"  # in a capture's folder
TIMED = 20  # timed evaluations of the motion encoder


def ablate(
    capture: Capture,
    base: TrainConfig,
    folder: Path,
    variants: Sequence[StudyRow],
    *,
    seeds: Sequence[int],
    perceptual: Perceptual | None,
    consistency: Perceptual | None = None,
    judge: Perceptual | None = None,
    mode: str = "table+sun",
    on_run: Callable[[str, int, float, int], None],
) -> list[dict[str, Any]]:
    """Train and score every variant with every seed; rows of rnd-eval with the encoder's cost.

    ``judge`` is the network of the scores, by default that of the training. The third stage is off by default. Runs
    with ``rows.json`` in ``folder/NAME-SEED`` are not repeated; those of other studies are refused before any training.
    ``on_run`` is called with the variant's name, the seed, the number of runs done (a fraction) and of all.
    """
    judge = perceptual if judge is None else judge
    learned = {MOTION: Path(capture.motion.source).name, CAPTURE: sha256_of(capture.file)}
    rows: list[dict[str, Any]] = []
    jobs: list[tuple[StudyRow, int, TrainConfig, list[dict[str, Any]]]] = []
    for seed in seeds:
        for variant in variants:
            config = _config(base, variant, seed)
            same = {
                "capture": capture.folder.resolve().name,
                "steps": config.steps,
                "gaussians": config.model.gaussians,
                "image_scale": config.image_scale,
                "hold_out": config.hold_out,
                "shade": mode,
                "lpips_weights_sha256": None if judge is None else judge.sha256,
                FEATURES: networks_sha256(consistency or perceptual),
                **learned,
            }
            run_folder = folder_of(folder, variant, seed)
            found = _rows(run_folder)
            if found:
                _refuse_others(found[0], same, "done", run_folder / ROWS)
            if (run_folder / STATE_FILE).exists():
                begun = read_state(run_folder / STATE_FILE)
                networks = networks_by_role(perceptual, consistency or perceptual)
                begun.refuse_other(config, networks, what="a run begun before", hint=ELSEWHERE)
                motion = {MOTION: NOISY_MOTION} if variant.noisy else {}
                _refuse_others(begun.header, learned | motion, "begun", run_folder / STATE_FILE)
            jobs.append((variant, seed, config, found))
    for done, (variant, seed, config, found) in enumerate(jobs):

        def on_share(share: float, name: str = variant.name, seed: int = seed, before: int = done) -> None:
            on_run(name, seed, before + share, len(jobs))

        on_share(0.0)
        if not found:
            run_folder = folder_of(folder, variant, seed)
            seen = _noisy(capture) if variant.noisy else capture
            training = train(seen, config, run_folder, perceptual, consistency, on_share)
            extra = _pose_errors(training, seen.motion, capture)
            checkpoint = load_checkpoint(run_folder / "avatar.ckpt")
            scored = score(checkpoint, capture, method=variant.name, mode=mode, perceptual=judge)
            extra |= encoder_cost(checkpoint.model) | _light_error(checkpoint, capture)
            write_json(run_folder / ROWS, [row | extra for row in scored])
            found = _rows(run_folder)
        rows += found
    return rows


def check_needs(variants: Iterable[StudyRow], capture: Capture) -> None:
    """Raise ``InputError`` if ``capture`` lacks data of one of ``variants``."""
    for variant in variants:
        if variant.noisy:
            _noisy(capture)
        if variant.train.get("light") == "capture":
            capture_lights(capture, f"variant {variant.name!r}")
        if variant.train.get("normals") == "true":
            check_true_normals(capture, capture.split("train"), f"variant {variant.name!r}")


def _config(base: TrainConfig, variant: StudyRow, seed: int) -> TrainConfig:
    model = dataclasses.replace(base.model, **variant.model)
    steps = max(round(base.steps * variant.length), 1)
    changed = {"steps": steps, "unseen_fraction": 0.0, **variant.train}
    return dataclasses.replace(base, model=model, seed=seed, **changed)


def _noisy(capture: Capture) -> Capture:
    return load_capture(capture.file, motion_file=NOISY_MOTION)


def _refuse_others(before: dict[str, Any], same: dict[str, Any], stage: str, file: Path) -> None:
    """Raise ``InputError`` if an earlier run differs from ``same``."""
    for name, value in same.items():
        got = before.get(name)
        if got != value:
            raise InputError(f"{name} of a run {stage} before", expected=value, got=got, file=file, hint=ELSEWHERE)


def _rows(run_folder: Path) -> list[dict[str, Any]]:
    file = run_folder / ROWS
    try:
        return earlier_rows(file, what="rows of a study", names=("method", "split", "seed", "psnr"))
    except InputError as error:
        what, expected = "a run done before", error.expected
        raise InputError(what, expected=expected, got=error.got, file=file, hint=ELSEWHERE) from error


def time_encoders(
    rows: list[dict[str, Any]], folder: Path, variants: Sequence[StudyRow], seed: int
) -> list[dict[str, Any]]:
    """``rows`` with every variant's ``encoder_cost`` measured in sequence on its avatar of ``seed``."""
    costs = {
        variant.name: encoder_cost(load_checkpoint(folder_of(folder, variant, seed) / "avatar.ckpt").model)
        for variant in variants
    }
    return [row | costs[row["method"]] for row in rows]


def _light_error(checkpoint: Checkpoint, capture: Capture) -> dict[str, float]:
    """``light_hue_de``, the ``hue_difference`` of the learned light, where the true one is known."""
    light = capture.split("train")[0].light
    if light is None or not capture.has_map(light):
        return {}
    learned = checkpoint.probe_of(light).double().numpy()
    return {"light_hue_de": hue_difference(learned, capture.load_light(light))}


@torch.no_grad()
def encoder_cost(model: AvatarModel) -> dict[str, float]:
    """GFLOP (2 per multiply-add) and median milliseconds in torch of the motion encoder D_W at its nodes."""
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


def train(
    capture: Capture,
    config: TrainConfig,
    folder: Path,
    perceptual: Perceptual | None,
    consistency: Perceptual | None = None,
    on_share: Callable[[float], None] = lambda share: None,
) -> Training:
    """A finished training in ``folder``; one that was begun there is resumed. ``on_share`` gets the share done."""
    folder.mkdir(parents=True, exist_ok=True)
    training = Training(capture, config, perceptual, consistency=consistency)
    if (folder / STATE_FILE).exists():
        resume_training(training, folder / STATE_FILE)
    cost = training.schedule.cost

    def on_step(step: StepResult) -> None:
        on_share(cost(step.index + 1) / cost(training.schedule.total))

    if run(training, folder, on_step=on_step, on_preview=lambda: None):
        raise KeyboardInterrupt
    return training


def _pose_errors(training: Training, given: Motion, truth: Capture) -> dict[str, float]:
    """Errors of the poses before and after a training, degrees; empty where they were the true ones."""
    if given.source == truth.motion.source:
        return {}
    frames = [view.frame.frame for view in training.views]
    return {
        "pose_error_before_deg": joint_error_degrees(given, truth.motion, frames),
        "pose_error_after_deg": joint_error_degrees(training.motion(), truth.motion, frames),
    }


def folder_of(folder: Path, variant: StudyRow, seed: int) -> Path:
    """Where one training of the study in ``folder`` is."""
    slug = "".join(c if c.isalnum() else "_" for c in variant.name).strip("_").lower()
    return folder / f"{slug}-{seed}"
