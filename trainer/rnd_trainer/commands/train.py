"""rnd-train: the command around ``training.training``."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rnd_runtime.cli.command import finish, log, parse, run_command, show, warn
from rnd_runtime.cli.jobs import run_jobs, workers
from rnd_runtime.cli.lock import folder_lock
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.errors import InputError, check_option, refuse_changed
from rnd_runtime.core.files import existing_file, output_folder, write_json
from rnd_runtime.core.kernels import COMPILING, kernels_are_cold

from .console import log_all, need_extra
from .eval import EvalOptions, evaluate_run
from .train_options import TrainOptions

if TYPE_CHECKING:
    from rnd_trainer.config import TrainConfig
    from rnd_trainer.training.lighting.lights import KnownLight
    from rnd_trainer.training.training import StepResult, Training

_KERNELS = Path(__file__).parents[1] / "losses"  # a module whose kernels training alone calls
PREVIEWS = 3
"""rows of a preview: evenly spaced training views"""
UNKNOWN = {"view": "rnd-view RUN shows a training while it runs"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``rnd-train``."""
    return run_command("rnd-train", lambda: _train_all(parse(TrainOptions, "rnd-train", arguments, unknown=UNKNOWN)))


def _train_all(options: TrainOptions) -> None:
    """Train on each capture, here or on workers."""
    need_extra()
    every = list(_each(options)) if options.more else [options]
    left = [one for one in every if not (options.skip_existing and _has_finished(one.out))]
    for one in left:
        _refuse_begun(one)
    if options.on is None:
        for one in left:
            _train(one)
        return
    with workers(options.on) as client:
        run_jobs(client, train_job, [(one,) for one in left], name="trainings")
    for one in left:
        finish(one.out / "avatar.ckpt")


def _each(options: TrainOptions) -> Iterator[TrainOptions]:
    """The options of each of several trainings."""
    captures = [options.capture, *options.more]
    names = [(path.parent if path.name == "capture.json" else path).resolve().stem for path in captures]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        expected = "captures of different names, each trained into OUT/NAME"
        raise InputError("CAPTURE", expected=expected, got=f"two of {', '.join(twice)}")
    for capture, name in zip(captures, names):
        out = options.out / name
        resume = options.resume and _has_begun(out)
        yield dataclasses.replace(options, capture=capture, more=(), out=out, resume=resume)


def train_job(options: TrainOptions) -> None:
    """Train in a worker; what was lost with its worker goes on from its last state."""
    _train(dataclasses.replace(options, resume=_has_begun(options.out)))


def _has_begun(folder: Path) -> bool:
    """Whether there is a state to resume from."""
    from rnd_trainer.training.state import STATE_FILE

    return (folder / STATE_FILE).exists()


def _has_finished(folder: Path) -> bool:
    from rnd_trainer.training.run import STATUS_FILE

    file = folder / STATUS_FILE
    try:
        status = json.loads(file.read_bytes()) if file.is_file() else None
    except (ValueError, RecursionError):  # damaged: not finished
        return False
    return isinstance(status, dict) and status.get("ended") == "finished"


def _refuse_begun(options: TrainOptions) -> None:
    """Raise ``InputError`` for a folder with a training unless it is resumed, and for one that cannot be."""
    from rnd_trainer.training.state import STATE_FILE

    folder, begun = options.out, _has_begun(options.out)
    if options.resume:
        existing_file(folder / STATE_FILE, what="state of a training to resume")
    elif begun or (folder / "avatar.ckpt").exists():
        hint = ("--resume continues it; or " if begun else "") + "choose another --out"
        raise InputError("holds a training already", file=folder, hint=hint)


def _train(options: TrainOptions) -> None:
    from rnd_runtime.capture.capture import load_capture
    from rnd_trainer.config import to_dict
    from rnd_trainer.losses.perceptual import load_features, load_lpips
    from rnd_trainer.training.notes import capture_notes
    from rnd_trainer.training.poses.uncertainty import FILE as UNCERTAINTY_FILE
    from rnd_trainer.training.saving import resume_training
    from rnd_trainer.training.state import STATE_FILE
    from rnd_trainer.training.training import Training

    config, device, learning = _config(options), _device(options.schedule.device), options.learning
    folder = options.out
    options = dataclasses.replace(options, capture=_capture_folder(options.capture, folder))
    capture = load_capture(options.capture, motion_file=learning.motion)
    if learning.motion is None and (capture.folder / UNCERTAINTY_FILE).is_file():
        config = dataclasses.replace(config, refine_poses=True)
    log_all(capture_notes(capture, ["train"] if config.light == "capture" else []))
    known = _known_light(options)
    if device == "cpu" and kernels_are_cold(_KERNELS):
        log(COMPILING)
    perceptual, features = load_lpips(learning.perceptual_weights), load_features(learning.consistency_weights)
    with _memory_error_in_one_line():
        training = Training(capture, config, perceptual, device, consistency=features, known=known)
    if options.resume:
        resume_training(training, folder / STATE_FILE)
    with folder_lock(output_folder(folder), "rnd-train"):
        write_json(folder / "config.json", to_dict(config))
        if perceptual is None:
            without = "" if features is not None else ", and no consistency loss"
            log(f"no --perceptual-weights: multi-scale DSSIM instead of LPIPS{without}")
        if config.light == "learn" and config.skin is None and known.place is None and known.card is None:
            log("no --skin 1 to 6 (Fitzpatrick): how bright the person is against the light is assumed")
        for frame in training.bad_masks:
            warn(f"frame {frame}: mask empty or full, skipped")
        log(f"{folder}: {training.schedule.total} steps; rnd-view {shlex.quote(str(folder))} shows them")
        with _memory_error_in_one_line():
            stopped = _run_with_progress(training, folder)
        checkpoint = folder / "avatar.ckpt"
        summary = f"{training.step_index} steps, {training.seconds / 60:.1f} min"
        if stopped:
            show(f"{checkpoint}: {summary}")
            words = [word for word in sys.argv[1:] if word != "--resume"]
            log(f"stopped; to continue: {shlex.join(['rnd-train', *words, '--resume'])}")
            raise KeyboardInterrupt
        _score_after_training(training, folder, options)
        finish(checkpoint, summary, then=f"rnd-export {shlex.quote(str(checkpoint))}")


def _capture_folder(source: Path, out: Path) -> Path:
    """``source``, or the capture in ``out`` that a video is imported into; one made before is taken as it is."""
    if not source.is_file() or source.suffix == ".json":
        return source
    from rnd_trainer.estimating.own_video import import_video, is_video_file
    from rnd_trainer.importing.options import ImportOptions
    from rnd_trainer.importing.report import import_and_report

    if not is_video_file(source):
        return source
    folder = out / "capture"
    if (folder / "capture.json").is_file():
        log(f"{folder}: the capture of {source} as it was imported")
        return folder
    if import_and_report(source, folder, ImportOptions(), import_video):
        hint = f"see {folder / 'check'}; rnd-data import {source} has options"
        raise InputError("capture of the video", expected="one without faults", got="the above", file=folder, hint=hint)
    return folder


def _config(options: TrainOptions) -> TrainConfig:
    """The preset with the changes of ``options``; raises ``InputError`` for invalid values."""
    from rnd_trainer.config import check_sizes, preset, resized

    schedule, ablations = options.schedule, options.ablations
    config = resized(preset(schedule.preset), schedule.gaussians, schedule.steps)
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, visibility=ablations.visibility),
        seed=schedule.seed,
        light=ablations.light,
        normals=ablations.normals,
        probe_channels=ablations.probe_channels,
        unseen_fraction=config.unseen_fraction if options.learning.unseen_poses else 0.0,
        refine_poses=options.learning.refine_poses,
        hold_out=options.learning.hold_out,
        skin=options.learning.skin,
        image_scale=config.image_scale if schedule.image_scale is None else schedule.image_scale,
        save_every=config.save_every if schedule.save_every is None else schedule.save_every,
    )
    check_option(0 <= schedule.seed < 2**63, "--seed", "0 to 2^63 - 1", schedule.seed)
    check_option(config.skin is None or 1 <= config.skin <= 6, "--skin", "1 to 6", config.skin)
    if ablations.light != "learn":
        refuse_changed(ablations, ["probe_channels"], f"--light {ablations.light} learns no light")
    if ablations.light == "none":
        refuse_changed(ablations, ["visibility"], "--light none has plain colours without shadows")
        refuse_changed(options.learning, ["consistency_weights"], "--light none has no consistency loss")
    check_sizes(config)
    check_option(config.save_every >= 1, "--save-every", "at least 1", config.save_every)
    return config


def _known_light(options: TrainOptions) -> KnownLight:
    """What the user knows of the light; raises ``InputError`` where none is learned."""
    from rnd_runtime.shading.files.load import load_light
    from rnd_trainer.training.lighting.grey_card import GreyCard
    from rnd_trainer.training.lighting.lights import KnownLight

    learning, light = options.learning, options.ablations.light
    if light != "learn":
        refuse_changed(learning, ["hdr", "grey_card"], f"--light {light} learns no light")
    place = None if learning.hdr is None else load_light(learning.hdr)
    return KnownLight(place, None if learning.grey_card is None else GreyCard.parse(learning.grey_card))


@contextmanager
def _memory_error_in_one_line() -> Iterator[None]:
    """Raise ``InputError`` when the GPU is out of memory."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        hint = "fewer --gaussians, a smaller --image-scale, or --device cpu"
        raise InputError("--device", expected="enough memory", got="a GPU that is full", hint=hint) from error


def _device(name: str) -> str:
    """``name`` if torch can use the device; raises ``InputError`` otherwise."""
    import torch

    from rnd_trainer.render.raster import gsplat_rasterization

    if name == "cpu":
        return name
    cuda = re.fullmatch("cuda(?::(0|[1-9][0-9]*))?", name)
    if cuda is None:
        raise InputError("--device", expected="cpu, cuda or cuda:NUMBER", got=name)
    if int(cuda[1] or 0) >= (count := torch.cuda.device_count()):
        got = f"{count} of them" if count else "none"
        raise InputError("--device", expected="a GPU that this torch can use", got=got, hint="--device cpu")
    gsplat_rasterization()
    return name


def _run_with_progress(training: Training, folder: Path) -> bool:
    """Train, report progress and write previews; True when Ctrl-C left steps to do."""
    from rnd_trainer.evaluation.preview import save_preview
    from rnd_trainer.training.run import run

    chosen = [k * len(training.views) // PREVIEWS for k in range(PREVIEWS)]
    shown = [training.views[k] for k in dict.fromkeys(chosen)]
    schedule = training.schedule
    smooth, warned = 0.0, False

    def on_step(step: StepResult) -> None:
        nonlocal smooth, warned
        done = step.index + 1
        image = step.terms.get("image")  # the third stage has no images
        if image is not None:
            smooth = 0.98 * smooth + 0.02 * image if smooth else image
        progress.update(schedule.cost(done), step=f"{done}/{schedule.total}", loss=None if image is None else smooth)
        if training.light_found is False and not warned:
            warned = True
            warn(
                "no sky and sun found in these images (too little of the person is visible, or one side only): "
                "the light is learned from white, which costs several dB"
            )
        if step.skipped:
            warn(f"step {step.index}: not finite, skipped")

    def on_preview() -> None:
        lit = training.stage > 1 and training.config.light != "none"
        motion = training.motion()  # as refined so far
        posed = [(view, training.pose(view, motion)) for view in shown]
        file = folder / "previews" / f"step_{training.step_index:06d}.png"
        save_preview(file, training.model, training.lights if lit else None, posed)

    with Progress() as progress:
        return run(training, folder, on_step=on_step, on_preview=on_preview, on_phase=progress.at)


def _score_after_training(training: Training, folder: Path, options: TrainOptions) -> None:
    """Score the held-out splits in the training's poses, refined if it refines them."""
    from rnd_trainer.evaluation.evaluate import scored_splits
    from rnd_trainer.training.saving import REFINED_MOTION

    learning = options.learning
    if any(training.capture.split(split) for split in scored_splits(training.config)):
        scoring = EvalOptions(
            folder,
            options.capture,
            json=folder / "eval.json",
            strips=folder / "eval",
            perceptual_weights=learning.perceptual_weights,
            motion=str((folder / REFINED_MOTION).resolve()) if training.config.refine_poses else learning.motion,
        )
        evaluate_run(scoring)
