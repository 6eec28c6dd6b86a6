"""rnd-train: the command around ``training.training``."""

from __future__ import annotations

import dataclasses
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rnd_runtime.core.errors import InputError, check_option, parse_options, refuse_changed, run_command
from rnd_runtime.core.files import existing_file, output_folder, write_json

from .eval import EvalOptions, evaluate_run, need_extra

if TYPE_CHECKING:
    from rnd_trainer.config import TrainConfig
    from rnd_trainer.training.training import Training

PREVIEWS = 3
"""rows of a preview picture: views spread over the training frames"""


@dataclass(frozen=True)
class TrainOptions:
    """Learn an avatar from one monocular capture."""

    capture: Annotated[Path, tyro.conf.Positional]
    """folder with capture.json"""
    out: Path = Path("runs/avatar")
    """folder for avatar.ckpt, previews/, metrics.jsonl and config.json"""
    preset: Literal["quick", "standard", "full"] = "standard"
    """schedule: some seven minutes, half an hour, hours on two cores"""
    resume: bool = False
    """continue a stopped training in OUT"""
    steps: int | None = None
    """with pictures, instead of the preset's 6000 (quick: 2000); the third stage, of unseen poses, adds three eighths
    as many (quick: half), which are short"""
    gaussians: int | None = None
    """instead of the preset's; an eighth of them, 1875 at most, are nodes"""
    save_every: int | None = None
    """steps between saved states, instead of the preset's; --resume goes on from the last one"""
    image_scale: float | None = None
    """shrink the pictures by this factor"""
    seed: int = 0
    """of every random draw"""
    perceptual_weights: Path | None = None
    """AlexNet, SqueezeNet or VGG16 (.safetensors or .pth): adds the LPIPS and consistency losses (with --light none the
    first alone)"""
    consistency_weights: Path | None = None
    """another of them, or its first few blocks, for the consistency loss"""
    unseen_poses: bool = True
    """when the pictures are done, teach the skinning poses that nobody filmed: a squat then tears less, and what was
    filmed hardly changes"""
    refine_poses: bool = False
    """correct the capture's body poses while training; writes refined_motion.npz"""
    light: Literal["learn", "capture", "none"] = "learn"
    """'capture': train under the capture's own light map (an oracle, for studies); 'none': plain colours"""
    normals: Literal["estimated", "true"] = "estimated"
    """'true': the capture's exact normals (an oracle, for studies)"""
    probe_channels: Literal[1, 3] = 3
    """1: a grey light"""
    visibility: Literal["pose", "paper", "none"] = "pose"
    """'paper': visibility towards the camera, as printed; 'none': no shadows (ablations, not exported)"""
    motion: str | None = None
    """another motion file of the capture, such as motion_noisy.npz"""
    device: str = "cpu"
    """'cuda' trains on a GPU: the same code, gsplat as its rasteriser (extra [cuda])"""
    view: bool = False
    """show the training on a page of this machine: previews, losses, time left"""


def main() -> None:
    """Entry point of ``rnd-train``."""

    def command() -> None:
        _train(parse_options(lambda: tyro.cli(TrainOptions, prog="rnd-train")))

    sys.exit(run_command("rnd-train", command))


def _train(options: TrainOptions) -> None:
    need_extra()
    from rnd_runtime.capture.capture import load_capture
    from rnd_trainer.config import to_dict
    from rnd_trainer.losses.perceptual import load_features, load_lpips
    from rnd_trainer.training.live_view import live_view
    from rnd_trainer.training.notes import capture_notes, say_notes
    from rnd_trainer.training.state import STATE_FILE
    from rnd_trainer.training.training import Training

    config, device = _config(options), _device(options.device)
    capture = load_capture(options.capture, motion_file=options.motion)
    say_notes("rnd-train", capture_notes(capture, ["train"] if options.light == "capture" else []))
    folder = options.out
    state = folder / STATE_FILE
    if not options.resume and (state.exists() or (folder / "avatar.ckpt").exists()):
        hint = ("--resume continues it; or " if state.exists() else "") + "choose another --out"
        raise InputError("holds a training already", file=folder, hint=hint)
    if options.resume:
        existing_file(state, what="state of a training to resume")
    perceptual = load_lpips(options.perceptual_weights)
    features = load_features(options.consistency_weights)
    with _memory_runs_out():
        training = Training(capture, config, perceptual, device, consistency=features)
    if options.resume:
        training.resume(state)
    write_json(output_folder(folder) / "config.json", to_dict(config))
    if perceptual is None:
        without = "" if features is not None else ", and no consistency loss"
        _say(f"no --perceptual-weights: multi-scale DSSIM instead of LPIPS{without}")
    for frame in training.bad_masks:
        _say(f"frame {frame}: mask empty or full, skipped")
    _say(f"{folder}: {training.schedule.total} steps in all")
    with live_view(folder, training.schedule) if options.view else nullcontext() as page:
        if page:
            _say(page)
        with _memory_runs_out():
            interrupted = _run_with_progress(training, folder)
        print(f"{folder / 'avatar.ckpt'}: {training.step_index} steps, {training.seconds / 60:.1f} min")  # noqa: T201
        if interrupted:
            words = [word for word in sys.argv[1:] if word != "--resume"]
            _say(f"stopped; to continue: {shlex.join(['rnd-train', *words, '--resume'])}")
            raise KeyboardInterrupt
        _score_after_training(training, folder, options)


def _say(what: str) -> None:
    print(f"rnd-train: {what}", file=sys.stderr)  # noqa: T201


def _config(options: TrainOptions) -> TrainConfig:
    """The preset with what ``options`` change; raises ``InputError`` for what no training can do."""
    from rnd_trainer.config import check_sizes, preset, resized

    config = resized(preset(options.preset), options.gaussians, options.steps)
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, visibility=options.visibility),
        seed=options.seed,
        light=options.light,
        normals=options.normals,
        probe_channels=options.probe_channels,
        unseen_fraction=config.unseen_fraction if options.unseen_poses else 0.0,
        refine_poses=options.refine_poses,
        image_scale=config.image_scale if options.image_scale is None else options.image_scale,
        save_every=config.save_every if options.save_every is None else options.save_every,
    )
    check_option(options.seed >= 0, "--seed", "at least 0", options.seed)
    check_option(options.seed < 2**63, "--seed", "less than 2^63", options.seed)
    if options.light != "learn":
        refuse_changed(options, ["probe_channels"], f"--light {options.light} learns no light")
    if options.light == "none":
        refuse_changed(options, ["visibility"], "--light none has plain colours, which no shadow falls on")
        refuse_changed(options, ["consistency_weights"], "--light none has no consistency loss")
    check_sizes(config)
    check_option(config.save_every >= 1, "--save-every", "at least 1", config.save_every)
    return config


@contextmanager
def _memory_runs_out() -> Iterator[None]:
    """Say in one line that the GPU has too little memory; the last saved state stands."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        hint = "fewer --gaussians, a smaller --image-scale, or --device cpu"
        raise InputError("--device", expected="enough memory", got="a GPU that is full", hint=hint) from error


def _device(name: str) -> str:
    """``name`` if torch can compute there; the CUDA path is refused where its parts are missing."""
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
    """Train with a progress bar; True when Ctrl-C ended it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from rnd_trainer.evaluation.preview import save_preview
    from rnd_trainer.training.run import run

    chosen = [k * len(training.views) // PREVIEWS for k in range(PREVIEWS)]
    shown = [training.views[k] for k in dict.fromkeys(chosen)]
    columns = (
        TextColumn("stage {task.fields[stage]}"),
        BarColumn(),
        TextColumn("{task.fields[told]}"),
        TimeElapsedColumn(),
        TextColumn("gone,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=60) as progress:
        schedule, begun = training.schedule, training.step_index
        task = progress.add_task(
            "training",
            total=schedule.effort(schedule.total),
            completed=int(schedule.effort(begun)),
            stage=training.stage,
            told=f"{begun}/{schedule.total}",
        )
        smooth: list[float] = []  # of the image loss

        def on_step(step: Any) -> None:
            done = step.index + 1
            if done == max(schedule.first_stage, 1) and training.light_found is False:
                progress.console.print(
                    "no sky and sun could be told from these pictures (too little is seen of the person, or always "
                    "from one side): the light is learned from white, which costs several dB"
                )
            told = f"{done}/{schedule.total}"
            if "image" in step.terms:  # the third stage has no pictures
                loss = step.terms["image"]
                smooth[:] = [0.98 * smooth[0] + 0.02 * loss if smooth else loss]
                told += f" image loss {smooth[0]:.4f}"
            progress.update(task, completed=schedule.effort(done), stage=step.stage, told=told)
            if step.skipped:
                progress.console.print(f"step {step.index}: not finite, skipped")

        def on_preview() -> None:
            name = f"step_{training.step_index:06d}.png"
            lit = training.stage > 1 and training.config.light != "none"
            light = training.light() if lit else None
            motion = training.motion()  # as it is corrected by now
            posed = [(view, training.pose(view, motion)) for view in shown]
            save_preview(folder / "previews" / name, training.model, light, posed)

        return run(training, folder, on_step=on_step, on_preview=on_preview)


def _score_after_training(training: Training, folder: Path, options: TrainOptions) -> None:
    """In the poses that it was trained with, corrected ones where they were."""
    from rnd_trainer.evaluation.evaluate import HELD_OUT
    from rnd_trainer.training.training import REFINED_MOTION

    if any(training.capture.split(split) for split in HELD_OUT):
        scoring = EvalOptions(
            folder,
            options.capture,
            json=folder / "eval.json",
            pictures=folder / "eval",
            perceptual_weights=options.perceptual_weights,
            motion=str((folder / REFINED_MOTION).resolve()) if options.refine_poses else options.motion,
        )
        evaluate_run(scoring)
