"""The consistency loss: points are matched where both cameras see them, and agreement lowers it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rnd_trainer.losses.consistency import GRAZING, PITCH, YAW, consistency_loss, covisible, project, virtual_camera
from rnd_trainer.losses.perceptual import Perceptual, load_perceptual
from rnd_trainer.losses.perceptual_nets import BACKBONES
from support.ball import front_camera, splat_ball


@pytest.fixture(scope="module")
def perceptual(tmp_path_factory) -> Perceptual:
    """An AlexNet of random weights."""
    from safetensors.torch import save_file

    generator = torch.Generator().manual_seed(0)
    network = BACKBONES[0]
    tensors = {name: 0.1 * torch.randn(shape, generator=generator) for name, shape in network.shapes().items()}
    path = tmp_path_factory.mktemp("net") / "random.safetensors"
    save_file(tensors, path)
    return load_perceptual(path)


def test_the_virtual_camera_keeps_its_distance_and_stays_in_range() -> None:
    generator, camera, centre = torch.Generator().manual_seed(0), front_camera(), torch.tensor([0.1, 0.0, 0.2])
    before = camera.position - centre.numpy()
    limit = math.hypot(YAW, PITCH) + 1e-9
    for _ in range(20):
        after = virtual_camera(camera, centre, generator).position - centre.numpy()
        assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
        cosine = after @ before / np.linalg.norm(before) ** 2
        assert math.acos(min(cosine, 1.0)) <= limit
        same = project(centre[None].double(), virtual_camera(camera, centre, generator))
        assert torch.allclose(same, project(centre[None].double(), camera))


def test_covisible_points_are_those_in_front_of_both() -> None:
    ball, camera = splat_ball(), front_camera()
    other = virtual_camera(camera, torch.zeros(3), torch.Generator().manual_seed(3))
    shared = covisible(ball, camera, other, 4000)
    facing = torch.ones(4000, dtype=torch.bool)
    for eye in (camera.position, other.position):
        towards = torch.nn.functional.normalize(torch.as_tensor(eye).float() - ball.means, dim=-1)
        facing &= (ball.normals * towards).sum(-1) > GRAZING
    assert facing[shared].all()
    # nothing hides a convex ball's points but its own rim, where the nearest splats come before the surface
    assert len(shared) > 0.6 * int(facing.sum())


def test_agreement_lowers_the_loss_and_disagreement_has_a_gradient(perceptual) -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(20, 20, 3, generator=generator).repeat_interleave(8, 0).repeat_interleave(8, 1)
    pixels = 20 + 120 * torch.rand(60, 2, generator=generator)
    same = consistency_loss(image, image, pixels, pixels, perceptual)
    moved = consistency_loss(image, image.roll(12, dims=1), pixels, pixels, perceptual)
    followed = consistency_loss(image, image.roll(12, dims=1), pixels, pixels + torch.tensor([12.0, 0.0]), perceptual)
    assert float(same) < 0.7 * float(moved)
    assert float(followed) < 0.8 * float(moved)
    leaf = image.clone().requires_grad_()
    consistency_loss(leaf, image.roll(12, dims=1), pixels, pixels, perceptual).backward()
    assert leaf.grad is not None and torch.isfinite(leaf.grad).all() and leaf.grad.abs().sum() > 0
