"""Blend skinning, covariances and normals of the trainer against plain float64 formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.model.skinning import (
    THICKNESS_FLOOR,
    blend_transforms,
    cofactor,
    covariances,
    small_rotation,
    tangent_frames,
    transform_normals,
    transform_points,
)

EXACT = 1e-12  # float64 against float64 in another order


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def _twist(degrees: float) -> torch.Tensor:
    """The blend of two bones, half each, one of them rotated about x."""
    rotated = axis_angle_to_matrix(np.array([math.radians(degrees), 0, 0]))
    bones = torch.zeros(2, 3, 4, dtype=torch.float64)
    bones[0, :, :3], bones[1, :, :3] = torch.eye(3), torch.as_tensor(rotated)
    return blend_transforms(torch.tensor([[0.5, 0.5]], dtype=torch.float64), bones)


def test_blending_is_the_weighted_sum_of_bones() -> None:
    weights, bones, points = _random(7, 3).softmax(-1), _random(3, 3, 4, seed=1), _random(7, 3, seed=2)
    expected = sum(weights[:, j : j + 1] * (points @ bones[j, :, :3].T + bones[j, :, 3]) for j in range(3))
    posed = transform_points(blend_transforms(weights, bones), points)
    assert torch.allclose(posed, expected, atol=EXACT, rtol=0)


def test_cofactor_is_det_times_inverse_transpose() -> None:
    matrices = _random(20, 3, 3)
    expected = torch.linalg.det(matrices)[:, None, None] * torch.linalg.inv(matrices).transpose(1, 2)
    assert torch.allclose(cofactor(matrices), expected, atol=1e-10, rtol=0)


def test_normals_stay_perpendicular_to_a_sheared_surface() -> None:
    blend = torch.eye(3, 4, dtype=torch.float64).repeat(5, 1, 1) + 0.3 * _random(5, 3, 4)
    tangents, normals = _random(5, 3, seed=1), _random(5, 3, seed=2)
    normals = torch.nn.functional.normalize(torch.cross(tangents, normals, dim=-1), dim=-1)
    posed = transform_normals(blend, normals)
    moved = torch.nn.functional.normalize((blend[:, :, :3] @ tangents[..., None])[..., 0], dim=-1)
    assert (posed * moved).sum(-1).abs().max() < 2e-3  # the fallback's share of 1e-3 tilts it by as much
    assert torch.allclose(posed.norm(dim=-1), torch.ones(5, dtype=torch.float64), atol=EXACT)


@pytest.mark.parametrize("degrees", [0, 60, 120, 150, 179, 180])
def test_twisted_normals_are_finite_and_point_out(degrees: float) -> None:
    normal = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    posed = transform_normals(_twist(degrees), normal)
    assert torch.isfinite(posed).all()
    if degrees < 180:  # at 180° the blend is flat and has no normal
        half = math.radians(degrees / 2)
        expected = torch.tensor([0.0, math.cos(half), math.sin(half)], dtype=torch.float64)
        assert (posed[0] @ expected) > math.cos(math.radians(1))


def test_covariances_are_positive_definite_for_any_factor() -> None:
    factors = _random(50, 3, 3)
    factors[:10] = 0
    factors[10:20, :, 2] = factors[10:20, :, 1]
    upper = covariances(factors)
    full = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    assert torch.linalg.eigvalsh(full).min() > 0.9 * THICKNESS_FLOOR**2
    expected = factors @ factors.transpose(1, 2) + THICKNESS_FLOOR**2 * torch.eye(3, dtype=torch.float64)
    assert torch.allclose(full, expected, atol=EXACT, rtol=0)


def test_small_rotations_are_axis_angle_to_second_order() -> None:
    w = 1e-3 * _random(30, 3)
    exact = torch.as_tensor(axis_angle_to_matrix(w.numpy()))
    assert (small_rotation(w) - exact).abs().max() < 1e-8  # the third-order term: |w|³/12
    large = small_rotation(_random(30, 3))
    assert torch.allclose(large @ large.transpose(1, 2), torch.eye(3, dtype=torch.float64), atol=EXACT)
    assert (torch.linalg.det(large) > 0).all()


def test_tangent_frames_are_rotations_with_the_normal_last() -> None:
    normals = torch.nn.functional.normalize(_random(100, 3), dim=-1)
    normals[0], normals[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    frames = tangent_frames(normals)
    assert torch.equal(frames[:, :, 2], normals)
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(frames.transpose(1, 2) @ frames, eye.expand(100, 3, 3), atol=1e-10)
    assert (torch.linalg.det(frames) > 0.999).all()
