"""The repulsion term: value, gradient and its part in training."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from rnd_trainer.losses.repulsion import repulsion
from rnd_trainer.training.training import Training

LEAST = 0.004  # m


def test_only_pairs_nearer_than_the_least_distance_cost():
    points = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0.1, 0, 0], [0.1, 0.0041, 0], [0.3, 0, 0.0]])
    assert float(repulsion(points, LEAST)) == pytest.approx((1 - 0.001 / LEAST) ** 2 / 5, rel=1e-5)
    assert float(repulsion(points[2:], LEAST)) == 0
    assert float(repulsion(points[:1], LEAST)) == float(repulsion(points[:0], LEAST)) == 0


def test_it_is_the_sum_over_all_pairs():
    points = np.random.default_rng(0).uniform(0, 0.03, (200, 3))
    distance = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(200, 1)]
    expected = np.square(np.maximum(1 - distance / LEAST, 0)).sum() / 200
    assert expected > 0.05
    assert float(repulsion(torch.as_tensor(points), LEAST)) == pytest.approx(expected, rel=1e-9)


def test_its_gradient_is_the_slope():
    points = torch.as_tensor(np.random.default_rng(1).uniform(0, 0.01, (12, 3))).requires_grad_()
    assert float(repulsion(points.detach(), LEAST)) > 0
    assert torch.autograd.gradcheck(lambda x: repulsion(x, LEAST), points, eps=1e-7, atol=1e-5)


def test_two_on_one_point_have_a_finite_gradient():
    points = torch.zeros((3, 3), requires_grad=True)
    value = repulsion(points, LEAST)
    value.backward()
    assert float(value.detach()) == pytest.approx(1, rel=1e-3)
    assert points.grad is not None
    assert bool((points.grad == 0).all())


def test_near_points_separate_and_others_stay():
    rng = np.random.default_rng(2)
    start = np.concatenate([rng.uniform(0, 0.02, (60, 3)), [[0.5, 0.5, 0.5]]]).astype(np.float32)
    points = torch.as_tensor(start).clone().requires_grad_()
    for _ in range(300):
        (step,) = torch.autograd.grad(repulsion(points, LEAST), points)
        points = (points - 0.1 * LEAST**2 * len(start) * step).detach().requires_grad_()

    def nearest(values):
        return float(cKDTree(values).query(values, k=2)[0][:, 1].min())

    moved = points.detach().numpy()
    assert nearest(start) < 0.4 * LEAST
    assert nearest(moved) > 0.95 * LEAST
    np.testing.assert_array_equal(moved[-1], start[-1])


def test_training_evaluates_repulsion_at_its_interval(tiny_capture, tiny_config):
    config = dataclasses.replace(tiny_config, least_distance=1.5, repulsion_every=3)
    training = Training(tiny_capture, config)
    model = training.model
    with torch.no_grad():
        points = model.attributes(model.encoded_nodes()).points
        expected = 3 * config.weight_repulsion * float(repulsion(points, 1.5 * float(model.spacing)))
    terms = [training.step().terms for _ in range(4)]
    assert ["repulsion" in t for t in terms] == [True, False, False, True]
    assert terms[0]["repulsion"] == pytest.approx(expected, rel=1e-6)
    assert expected > 0
    without = Training(tiny_capture, dataclasses.replace(config, weight_repulsion=0.0))
    assert "repulsion" not in without.step().terms


def test_only_residual_offsets_get_gradients(tiny_capture, tiny_config):
    training = Training(tiny_capture, dataclasses.replace(tiny_config, least_distance=1.5))
    posed = training.model(training.poses[0])
    training.objective._repulsion(training.model, posed).backward()
    pushed = {name for name, p in training.model.named_parameters() if p.grad is not None and p.grad.any()}
    assert pushed == {"geometry_residual"}
    columns = training.model.geometry_residual.grad.any(dim=0)
    assert columns.tolist() == [False] * 10 + [True] * 3  # opacity, rotation, scale, normal; offset
