"""Training on a tiny capture: loss, stages, resuming, refusals, interrupts."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from safetensors import SafetensorError
from safetensors.torch import save_file

import rnd_trainer.commands.train
import rnd_trainer.model.checkpoint
import rnd_trainer.training.training
from rnd_runtime.capture.capture import CaptureLight, load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_trainer.commands.eval import EvalOptions, evaluate_run
from rnd_trainer.losses.losses import linear_to_srgb
from rnd_trainer.losses.perceptual import load_features, load_lpips
from rnd_trainer.losses.perceptual_nets import BACKBONES
from rnd_trainer.model.checkpoint import load_checkpoint, read_tensors, write_tensors
from rnd_trainer.training.lighting.lights import TrainingLights
from rnd_trainer.training.objective import Objective
from rnd_trainer.training.run import run
from rnd_trainer.training.saving import resume_training, save_training
from rnd_trainer.training.state import STATE_SCHEMA
from rnd_trainer.training.training import MAX_BAD_STEPS, Training
from trainer.losses.perceptual_test import write_alexnet


def _nothing(*_: object) -> None:
    pass


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_training_lowers_the_image_loss(tiny_capture, tiny_config) -> None:
    config = dataclasses.replace(tiny_config, steps=120, stage1_fraction=0.5)
    training = Training(tiny_capture, config)
    losses = [training.step().terms["image"] for _ in range(config.steps)]
    first, stage1, end = (np.mean(part) for part in (losses[:6], losses[54:60], losses[-6:]))
    assert stage1 < 0.6 * first
    assert end < 0.6 * first  # shaded: the light is learned from white in sixty steps


def test_half_of_the_backgrounds_are_black_and_half_random(tiny_config) -> None:
    objective = Objective(tiny_config, TrainingLights(("white",)), None, None, torch.Generator().manual_seed(0))
    sampled = torch.stack([objective._background() for _ in range(400)])
    black = (sampled == 0).all(dim=1)
    assert 0.4 < black.float().mean() < 0.6
    deciles = linear_to_srgb(sampled[~black]).flatten().quantile(torch.linspace(0.1, 0.9, 9))
    torch.testing.assert_close(deciles, torch.linspace(0.1, 0.9, 9), atol=0.06, rtol=0)


def test_all_stages_write_a_complete_checkpoint(tiny_run, tiny_config) -> None:
    rows = [json.loads(line) for line in (tiny_run / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(14))
    assert [row["stage"] for row in rows] == [1] * 6 + [2] * 6 + [3] * 2
    assert "chroma" in rows[11] and "chroma" not in rows[0]
    assert "image" in rows[11] and set(rows[-1]) == {"step", "stage", "seconds", "distillation", "edges", "smoothness"}
    assert load_checkpoint(tiny_run / "avatar.ckpt").info["step"] == 14
    status = json.loads((tiny_run / "status.json").read_text())
    assert (status["step"], status["steps"], status["ended"]) == (14, 14, "finished")


def test_a_run_reports_its_phases_with_the_light_search(tiny_capture, tiny_config, tmp_path) -> None:
    phases: dict[str, int] = {}

    def count(name: str, done: float, total: float) -> None:
        assert json.loads((tmp_path / "status.json").read_text())["phase"] == name
        phases[name] = phases.get(name, 0) + 1

    training = Training(tiny_capture, tiny_config)
    run(training, tmp_path, on_step=_nothing, on_preview=_nothing, on_phase=count)
    assert list(phases) == ["warming up", "geometry", "searching the light", "albedo and light", "unseen poses"]
    assert phases["searching the light"] >= 2


def test_the_state_after_the_first_stage_is_lit(tiny_capture, tiny_config, tmp_path, one_thread) -> None:
    """Resuming does not initialise the light again."""
    training = Training(tiny_capture, tiny_config)
    while training.step_index < 6:
        assert not training.lit
        training.step()
    save_training(training, tmp_path)
    saved = load_checkpoint(tmp_path / "avatar.ckpt").model.appearance_residual
    colour, albedo = saved[:, :3], saved[:, 3:6]
    assert colour.any() and torch.equal(albedo, colour)  # the first stage learns colours alone
    resumed = Training(tiny_capture, tiny_config)
    resume_training(resumed, tmp_path / "training.state")
    assert training.lit and resumed.lit and resumed.step().terms == training.step().terms


def test_warm_up_evaluates_every_term_without_effect(tiny_capture, tiny_config, one_thread, monkeypatch) -> None:
    plain, warmed = Training(tiny_capture, tiny_config), Training(tiny_capture, tiny_config)
    asked = []

    def spy(*given):
        asked.append(original(*given))
        return asked[-1]

    original = warmed.objective
    monkeypatch.setattr(warmed, "objective", spy)
    warmed.warm_up()
    monkeypatch.undo()
    assert {"image", "mask", "visibility", "chroma", "sky"} <= set(asked[0])
    assert warmed.step_index == 0 and warmed.seconds > 0
    assert [plain.step().terms for _ in range(8)] == [warmed.step().terms for _ in range(8)]


def test_resuming_continues_the_same_curve(tiny_capture, tiny_config, tmp_path, one_thread) -> None:
    whole = Training(tiny_capture, tiny_config)
    expected = [whole.step().terms for _ in range(14)]
    half = Training(tiny_capture, tiny_config)
    for stop in (7, 13):  # in the second stage, in the third
        while half.step_index < stop:
            half.step()
        save_training(half, tmp_path)
        resumed = Training(tiny_capture, tiny_config)
        resume_training(resumed, tmp_path / "training.state")
        assert [resumed.step().terms for _ in range(stop, 14)] == expected[stop:]
        for ours, theirs in zip(whole.model.parameters(), resumed.model.parameters()):
            assert torch.equal(ours, theirs)


def test_the_third_stage_can_be_added_when_resuming(tiny_capture, tiny_config, tmp_path, one_thread) -> None:
    whole = Training(tiny_capture, tiny_config)
    run(whole, tmp_path / "whole", on_step=_nothing, on_preview=_nothing)
    without = dataclasses.replace(tiny_config, unseen_fraction=0.0)
    run(Training(tiny_capture, without), tmp_path / "without", on_step=_nothing, on_preview=_nothing)
    later = Training(tiny_capture, tiny_config)
    resume_training(later, tmp_path / "without/training.state")
    assert later.step_index == 12
    later.step(), later.step()
    for ours, theirs in zip(whole.model.parameters(), later.model.parameters()):
        assert torch.equal(ours, theirs)
    with pytest.raises(InputError, match=r"got other \['unseen_fraction'\]"):  # nor back again
        resume_training(Training(tiny_capture, without), tmp_path / "whole/training.state")


@pytest.mark.parametrize("light", ["learn", "none"])
def test_the_third_stage_changes_the_skinning_only(tiny_capture, tiny_config, light) -> None:
    training = Training(tiny_capture, dataclasses.replace(tiny_config, light=light))
    while training.stage < 3:
        training.step()
    before = {name: p.detach().clone() for name, p in training.model.named_parameters()}
    probe = training.lights.probes.raw.detach().clone()
    while training.step_index < training.schedule.total:
        training.step()
    changed = {name.split(".")[0] for name, p in training.model.named_parameters() if not torch.equal(p, before[name])}
    assert changed == {"skinning"} and torch.equal(probe, training.lights.probes.raw)


def test_static_skinning_has_no_third_stage(tiny_capture, tiny_config) -> None:
    still = dataclasses.replace(tiny_config.model, dynamic_skinning=False)
    assert Training(tiny_capture, dataclasses.replace(tiny_config, model=still)).schedule.total == 12


def test_resuming_with_another_configuration_is_refused(tiny_run, tiny_capture, tiny_config) -> None:
    other = Training(tiny_capture, dataclasses.replace(tiny_config, seed=5))
    with pytest.raises(InputError, match=r"--resume: expected the configuration .* got other \['seed'\]"):
        resume_training(other, tiny_run / "training.state")


def test_resuming_on_other_images_or_poses_is_refused(tiny_run, tiny_capture, tiny_config) -> None:
    moved = dataclasses.replace(tiny_capture.motion, translations=tiny_capture.motion.translations + 0.01)
    fewer = tuple(frame for frame in tiny_capture.frames if frame.frame != tiny_capture.frames[0].frame)
    first, second, *others = tiny_capture.frames
    swapped = (replace(first, frame=second.frame), replace(second, frame=first.frame), *others)
    bodies = tiny_capture.body
    wider = dataclasses.replace(bodies, vertices=bodies.vertices * [1.01, 1, 1])
    for other in ({"motion": moved}, {"frames": fewer}, {"frames": swapped}, {"body": wider}):
        training = Training(dataclasses.replace(tiny_capture, **other), tiny_config)
        with pytest.raises(InputError, match="expected the images and poses it was started with, got others"):
            resume_training(training, tiny_run / "training.state")


def test_resuming_under_another_light_of_the_capture_is_refused(tiny_capture, tiny_config, tmp_path) -> None:
    config = dataclasses.replace(tiny_config, light="capture")
    save_training(Training(tiny_capture, config), tmp_path)
    resume_training(Training(tiny_capture, config), tmp_path / "training.state")
    white = tiny_capture.lights["white"]
    brighter = {"white": replace(white, scale=(2.0, 2.0, 2.0))}
    with pytest.raises(InputError, match="expected the images and poses it was started with, got others"):
        resume_training(
            Training(dataclasses.replace(tiny_capture, lights=brighter), config), tmp_path / "training.state"
        )


def test_a_last_bit_of_a_pose_does_not_change_the_digest(tiny_run, tiny_capture, tiny_config) -> None:
    moves = tiny_capture.motion
    near = dataclasses.replace(moves, rotations=np.nextafter(moves.rotations, 2))
    resume_training(Training(dataclasses.replace(tiny_capture, motion=near), tiny_config), tiny_run / "training.state")


def test_the_save_interval_may_change_when_resuming(tiny_run, tiny_capture, tiny_config) -> None:
    config = dataclasses.replace(tiny_config, save_every=3, preview_every=5)
    resume_training(Training(tiny_capture, config), tiny_run / "training.state")


def test_crops_too_small_for_the_network_skip_its_losses(tiny_capture, tiny_config) -> None:

    class Demanding:
        smallest = 10**4

        def in_bfloat16(self):
            return self

    training = Training(tiny_capture, tiny_config, Demanding())
    terms = training.objective(training.model, training.views[0], training.poses[0], 0, 1)
    assert "image" in terms and "lpips" not in terms and "consistency" not in terms


def test_the_consistency_loss_has_a_network_of_its_own(tiny_capture, tiny_config, tmp_path) -> None:
    """A network's first blocks are enough; resuming with another one is refused."""
    tensors = {name: torch.randn(shape) / 30 for name, shape in BACKBONES[-1].shapes(2).items()}
    for name in ("a", "b"):
        save_file({k: v + (name == "b") for k, v in tensors.items()}, tmp_path / f"{name}.safetensors")
    blocks, others = (load_features(tmp_path / f"{name}.safetensors") for name in ("a", "b"))
    config = dataclasses.replace(tiny_config, image_scale=1.0)
    training = Training(tiny_capture, config, consistency=blocks)
    given = (training.model, training.views[0], training.poses[0], 0, 2)
    assert "consistency" in training.objective(*given) and "lpips" not in training.objective(*given)
    assert "consistency" not in Training(tiny_capture, config).objective(*given)
    save_training(training, tmp_path)
    assert load_checkpoint(tmp_path / "avatar.ckpt").info["consistency"] == "vgg16[:2]"
    resume_training(Training(tiny_capture, config, consistency=blocks), tmp_path / "training.state")
    with pytest.raises(InputError, match="--resume: expected the perceptual weights"):
        resume_training(Training(tiny_capture, config, consistency=others), tmp_path / "training.state")


def test_resuming_tolerates_a_byte_of_difference_in_downscaled_images(tiny_capture, tiny_config, tmp_path) -> None:
    """Rounding differs between CPUs."""
    config = dataclasses.replace(tiny_config, image_scale=0.5)
    save_training(Training(tiny_capture, config), tmp_path)
    other = Training(tiny_capture, config)
    other.views[0].image[0, 0, 0] += 1
    resume_training(other, tmp_path / "training.state")
    whole = Training(tiny_capture, tiny_config)
    save_training(whole, tmp_path)
    other = Training(tiny_capture, tiny_config)
    other.views[0].image[0, 0, 0] += 1
    with pytest.raises(InputError, match="expected the images and poses it was started with"):
        resume_training(other, tmp_path / "training.state")


def test_a_full_disk_is_an_input_error(tmp_path, monkeypatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(rnd_trainer.model.checkpoint, "save_file", full)
    with pytest.raises(InputError, match=r"a\.ckpt: cannot be written: got .*No space left on device"):
        write_tensors(tmp_path / "a.ckpt", {"a": torch.zeros(1)}, {})
    assert not list(tmp_path.iterdir())


def test_a_training_with_lpips_and_its_features_is_resumed(tiny_capture, tiny_config, tmp_path) -> None:
    """One network in both roles, as --perceptual-weights gives it."""
    write_alexnet(tmp_path / "alexnet.safetensors")
    network = load_lpips(tmp_path / "alexnet.safetensors")
    save_training(Training(tiny_capture, tiny_config, network), tmp_path)
    resume_training(Training(tiny_capture, tiny_config, network), tmp_path / "training.state")
    for other in ({}, {"perceptual": network, "consistency": load_features(_half_of(tmp_path))}):
        with pytest.raises(InputError, match="--resume: expected the perceptual weights"):
            resume_training(Training(tiny_capture, tiny_config, **other), tmp_path / "training.state")


def _half_of(folder: Path) -> Path:
    """Another network's first blocks."""
    tensors = {name: torch.randn(shape) / 30 for name, shape in BACKBONES[-1].shapes(2).items()}
    save_file(tensors, folder / "blocks.safetensors")
    return folder / "blocks.safetensors"


def test_a_state_with_other_fields_is_refused(tiny_run, tiny_capture, tiny_config, tmp_path) -> None:
    tensors, header = read_tensors(tiny_run / "training.state", STATE_SCHEMA)
    training = Training(tiny_capture, tiny_config)
    for broken in (header["config"] | {"weight_of_tomorrow": 1.0}, [], None):
        write_tensors(tmp_path / "broken.state", tensors, header | {"config": broken})
        with pytest.raises(InputError, match=r"broken\.state: not a training state"):
            resume_training(training, tmp_path / "broken.state")


def test_ctrl_c_finishes_the_step_and_saves(tiny_capture, tiny_config, tmp_path) -> None:
    def press(step: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    training = Training(tiny_capture, tiny_config)
    assert run(training, tmp_path, on_step=press, on_preview=_nothing)
    assert training.step_index == 1
    assert load_checkpoint(tmp_path / "avatar.ckpt").info["step"] == 1
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_in_the_last_step_ends_a_finished_training(tiny_capture, tiny_config, tmp_path) -> None:
    config = dataclasses.replace(tiny_config, steps=2, unseen_fraction=0.0)

    def press(step: object) -> None:
        if step.index == 1:
            os.kill(os.getpid(), signal.SIGINT)

    assert not run(Training(tiny_capture, config), tmp_path, on_step=press, on_preview=_nothing)


def test_the_log_drops_repeated_steps(tiny_capture, tiny_config, tmp_path) -> None:
    training = Training(tiny_capture, dataclasses.replace(tiny_config, steps=2))
    (tmp_path / "metrics.jsonl").write_text(
        '{"step": 0}\n{"step": 0, "ima\n[0]\n3\n{"steps": 0}\n{"step": "0"}\n{}}\n{"step": 1}\n{"step": 2}\n{"st'
    )
    training.step_index = 1
    run(training, tmp_path, on_step=_nothing, on_preview=_nothing)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [0, 1]
    assert "image" in rows[1]


def test_steps_that_are_not_finite_are_skipped_and_end_the_run(tiny_capture, tiny_config) -> None:
    training = Training(tiny_capture, tiny_config)
    training.step()
    with torch.no_grad():
        training.model.appearance_residual[0, 0] = float("nan")
    kept = training.model.geometry_residual.detach().clone()
    assert training.step().skipped
    assert torch.equal(training.model.geometry_residual, kept)
    with pytest.raises(InputError, match=f"{MAX_BAD_STEPS} steps in a row were not finite"):
        for _ in range(MAX_BAD_STEPS):
            training.step()


def test_empty_masks_are_counted_and_too_many_stop(tiny_capture, tiny_config, tmp_path) -> None:
    import shutil

    folder = tmp_path / "capture"
    shutil.copytree(tiny_capture.folder, folder)
    frames = tiny_capture.split("train")
    empty = np.zeros((64, 64, 1), np.uint8)
    write_image(folder / frames[2].mask, empty)
    training = Training(load_capture(folder), tiny_config)
    assert training.bad_masks == [2] and len(training.views) == 5
    write_image(folder / frames[4].mask, empty + 255)
    with pytest.raises(InputError, match="masks: expected at most 20% empty or full, got 2 of 6"):
        Training(load_capture(folder), tiny_config)


def test_training_under_the_captures_light_keeps_it(tiny_capture, tiny_config) -> None:
    training = Training(tiny_capture, dataclasses.replace(tiny_config, light="capture"))
    for _ in range(12):
        training.step()
    assert torch.allclose(training.lights.radiance(), torch.ones(1, 32, 64, 3), atol=1e-5)


def test_a_capture_under_two_lights_learns_a_probe_of_each(tiny_capture, tiny_config, tmp_path, one_thread) -> None:
    """One avatar; the most used light is the default one; both go on after a resume."""
    frames = tuple(replace(f, light="dusk" if f.frame in (1, 4) else "white") for f in tiny_capture.frames)
    lights = tiny_capture.lights | {"dusk": CaptureLight("lights/white.exr", (2.0, 1.0, 1.0))}
    two = dataclasses.replace(tiny_capture, frames=frames, lights=lights)
    training = Training(two, tiny_config)
    while training.step_index < 9:
        training.step()
    save_training(training, tmp_path)
    checkpoint = load_checkpoint(tmp_path / "avatar.ckpt")
    assert list(checkpoint.probes) == ["white", "dusk"] and checkpoint.learned_under(two) == {"white", "dusk"}
    assert torch.equal(checkpoint.probe, checkpoint.probe_of("white")) and checkpoint.probe_of(None) is checkpoint.probe
    assert not torch.allclose(checkpoint.probe, checkpoint.probe_of("dusk"), rtol=1e-3)
    resumed = Training(two, tiny_config)
    resume_training(resumed, tmp_path / "training.state")
    assert resumed.step().terms == training.step().terms
    renamed = dataclasses.replace(two, frames=tuple(replace(f, light="white") for f in frames))
    with pytest.raises(InputError, match="--resume: expected the images"):
        resume_training(Training(renamed, tiny_config), tmp_path / "training.state")
    fixed = Training(two, dataclasses.replace(tiny_config, light="capture")).lights
    assert not fixed.learned
    assert torch.allclose(fixed.radiance()[1], torch.tensor([2.0, 1.0, 1.0]))


def test_training_under_the_captures_lights_needs_all_of_them(tiny_capture, tiny_config) -> None:
    frames = tuple(replace(f, light=None if f.frame == 2 else f.light) for f in tiny_capture.frames)
    without = dataclasses.replace(tiny_capture, frames=frames)
    with pytest.raises(InputError, match="--light capture: expected a light map of every training image, got unknown"):
        Training(without, dataclasses.replace(tiny_config, light="capture"))


def test_a_missing_device_is_refused() -> None:
    from rnd_trainer.commands.train import _device

    assert _device("cpu") == "cpu"
    with pytest.raises(InputError, match="--device: expected cpu, cuda or cuda:NUMBER, got teapot"):
        _device("teapot")


def test_a_device_is_named_as_torch_names_it(monkeypatch) -> None:
    from rnd_trainer.commands.train import _device

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=None))
    assert [_device(name) for name in ("cuda", "cuda:0", "cuda:1")] == ["cuda", "cuda:0", "cuda:1"]
    for typo in ("cuda:", "cuda0", "cuda:00", "cuda:01", "cuda:٠", "cuda:0\n"):
        with pytest.raises(InputError, match="--device: expected cpu, cuda or cuda:NUMBER, got"):
            _device(typo)
    with pytest.raises(InputError, match="expected a GPU that this torch can use, got 2 of them"):
        _device("cuda:2")
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match=r"gsplat cannot be imported: .*rnd-avatar\[cuda\]"):
        _device("cuda")


def test_a_full_gpu_is_an_input_error_and_keeps_the_last_state(tiny_capture, tmp_path, monkeypatch, capsys) -> None:
    def step(self: Training) -> Any:
        if self.step_index == 3:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return one_step(self)

    one_step = Training.step
    monkeypatch.setattr(Training, "step", step)
    sizes = ["--preset", "quick", "--gaussians", "200", "--steps", "5", "--save-every", "2"]
    out = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", ["rnd-train", str(tiny_capture.folder), "--out", str(out), *sizes])
    assert rnd_trainer.commands.train.main() == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("rnd-train: --device: expected enough memory, got a GPU that is full (fewer")
    assert load_checkpoint(out / "avatar.ckpt").info["step"] == 2


def test_a_training_stopped_in_the_first_stage_has_a_note(tiny_capture, tiny_config, tmp_path, capsys) -> None:
    training = Training(tiny_capture, tiny_config)
    training.step()
    save_training(training, tmp_path)
    note = load_checkpoint(tmp_path / "avatar.ckpt").note()
    assert note is not None and "stopped at step 1 of 14, before light and albedo were learned" in note
    evaluate_run(EvalOptions(tmp_path, tiny_capture.folder))
    assert note in capsys.readouterr().err


def test_a_finished_training_has_no_note(tiny_run) -> None:
    assert load_checkpoint(tiny_run / "avatar.ckpt").note() is None


def test_plain_colours_learn_no_visibility(tiny_capture, tiny_config) -> None:
    plain = Training(tiny_capture, dataclasses.replace(tiny_config, light="none"))
    assert "visibility" not in plain.step().terms
    assert "visibility" in Training(tiny_capture, tiny_config).step().terms
