"""Training on a GPU: the plain torch formulas and gsplat there, against the compiled kernels of the CPU.

Skipped where there is no GPU, as in CI.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from rnd_runtime.avatar.avatar import Avatar
from rnd_trainer.evaluation.preview import save_preview
from rnd_trainer.losses.perceptual import load_lpips
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.render import raster
from rnd_trainer.training.run import run
from rnd_trainer.training.saving import resume_training, save_training
from rnd_trainer.training.training import Training
from support.raster_scenes import off_centre_camera, random_scene
from trainer.losses.perceptual_test import write_alexnet

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SPLAT_MSE = 1e-8  # 80 dB: gsplat's depths and conics are float32
GRADIENT = 1e-2  # relative L2, as between our own kernel and its oracle in float32
TERMS = 1e-2  # relative: gsplat differs where alpha is clamped


@pytest.fixture(autouse=True)
def _gsplat() -> None:
    pytest.importorskip("gsplat")


def test_gsplat_splats_what_the_cpu_splats() -> None:
    scene, camera = random_scene(4), off_centre_camera(64, 48)
    scene = (scene[0], scene[1], 0.9 * scene[2], scene[3])  # below gsplat's and our clamp
    results = []
    for device in ("cpu", "cuda"):
        arrays = [torch.tensor(array, device=device, requires_grad=True) for array in scene]
        images = raster.rasterize(*arrays, camera, depth=True)
        draw = torch.Generator().manual_seed(0)
        weights = [torch.randn(image.shape, generator=draw) for image in images]
        sum((p * w.to(p)).sum() for p, w in zip(images, weights)).backward()
        results.append(([p.detach().cpu() for p in images], [a.grad.cpu() for a in arrays]))
    for ours, theirs in zip(*(images for images, _ in results)):
        assert torch.mean((ours - theirs) ** 2) < SPLAT_MSE
    for ours, theirs in zip(*(grads for _, grads in results)):
        assert torch.linalg.vector_norm(ours - theirs) <= GRADIENT * torch.linalg.vector_norm(ours)


def test_every_loss_and_its_gradient_are_the_cpus(tiny_capture, tiny_config, tmp_path) -> None:
    """Of one step of the second stage in which all terms are due."""
    write_alexnet(tmp_path / "alexnet.safetensors")
    network = load_lpips(tmp_path / "alexnet.safetensors")
    terms, gradients = [], []
    for device in ("cpu", "cuda"):
        training = Training(tiny_capture, tiny_config, network, device)
        found = training.objective(training.model, training.views[0], training.poses[0], 0, 2)
        torch.stack(list(found.values())).sum().backward()
        terms.append({name: float(value.detach()) for name, value in found.items()})
        named = [*training.model.named_parameters(), *training.lights.probes.named_parameters()]
        gradients.append({name: p.grad.cpu() for name, p in named if p.grad is not None})
    assert terms[1] == pytest.approx(terms[0], rel=TERMS, abs=1e-6)
    assert gradients[0].keys() == gradients[1].keys()
    ours, theirs = (torch.cat([g.flatten() for g in grads.values()]) for grads in gradients)
    assert torch.linalg.vector_norm(ours - theirs) <= 10 * GRADIENT * torch.linalg.vector_norm(ours)


@pytest.mark.parametrize("changes", [{}, {"refine_poses": True}], ids=["as it is", "refining poses"])
def test_a_training_on_the_gpu_runs_all_stages(changes, tiny_capture, tiny_config, tmp_path: Path) -> None:
    """All three stages, a preview in each, stopped and resumed in the third; and the avatar plays on the CPU."""
    config = dataclasses.replace(tiny_config, save_every=13, **changes)
    training = Training(tiny_capture, config, device="cuda")
    while training.step_index < 13:
        assert not training.step().skipped
    save_training(training, tmp_path)
    resumed = Training(tiny_capture, config, device="cuda")
    resume_training(resumed, tmp_path / "training.state")
    assert resumed.step_index == 13

    def preview() -> None:
        shown = [(view, resumed.pose(view, resumed.motion())) for view in resumed.views[:2]]
        save_preview(tmp_path / "preview.png", resumed.model, resumed.lights, shown)

    assert not run(resumed, tmp_path, on_step=lambda step: None, on_preview=preview)
    assert (tmp_path / "preview.png").stat().st_size > 0
    checkpoint = load_checkpoint(tmp_path / "avatar.ckpt")
    assert checkpoint.model.points.device.type == "cpu"
    assert all(bool(torch.isfinite(p).all()) for p in checkpoint.model.parameters())


def test_an_avatar_trained_on_the_gpu_plays_anywhere(tiny_capture, tiny_config, tmp_path: Path) -> None:
    from rnd_export.export import export

    training = Training(tiny_capture, tiny_config, device="cuda")
    run(training, tmp_path, on_step=lambda step: None, on_preview=lambda: None)
    export(load_checkpoint(tmp_path / "avatar.ckpt"), tmp_path / "avatar.onnx")
    avatar = Avatar.load(tmp_path / "avatar.onnx")
    gaussians = avatar.pose(training.capture.motion, 0.05)
    assert np.isfinite(gaussians.means).all() and len(gaussians.means) == tiny_config.model.gaussians
