"""The compiled posing against the plain torch version in float64, forward and by gradient."""

from __future__ import annotations

import math

import pytest
import torch

from rnd_trainer.model.posing import pose_gaussians
from rnd_trainer.model.twist import TwistFrames

RELATIVE = 2e-5  # float32 against float64: products of five 3×3 matrices
WANTED = (0, 1, 2, 3, 5, 6, 7)  # arguments that have a gradient
LIMBS = slice(8, 11)  # axes, levers and shares


def _scene(count: int, joints: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    bones = torch.cat([torch.eye(3, dtype=torch.float64).expand(joints, 3, 3), normal(joints, 3, 1)], dim=2)
    return [
        (3 * normal(count, joints)).softmax(-1),
        bones + 0.3 * normal(joints, 3, 4),
        normal(count, 3),
        normal(count, 3),
        torch.linalg.qr(normal(count, 3, 3))[0],
        normal(count, 3),
        0.01 * (1 + normal(count, 3).abs()),
        torch.nn.functional.normalize(normal(count, 3), dim=-1),
        torch.nn.functional.normalize(normal(count, 3), dim=-1),
        0.1 * normal(count, 3),
        torch.rand(count, dtype=torch.float64, generator=generator),
    ]


def _pose(arguments: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return pose_gaussians(*arguments[: LIMBS.start], TwistFrames(*arguments[LIMBS]))


def _relative(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    return float((ours.double() - theirs).norm() / theirs.norm())


@pytest.mark.parametrize(("count", "joints"), [(200, 24), (1, 2), (7, 55)])
def test_compiled_posing_equals_the_float64_formulas(count: int, joints: int) -> None:
    scene = _scene(count, joints)
    slow = [t.clone().requires_grad_(i in WANTED) for i, t in enumerate(scene)]
    fast = [t.float().requires_grad_(i in WANTED) for i, t in enumerate(scene)]
    expected, ours = _pose(slow), _pose(fast)
    generator = torch.Generator().manual_seed(1)
    incoming = [torch.randn(t.shape, dtype=torch.float64, generator=generator) for t in expected]
    incoming[1] *= 1e4  # covariances are in m², a thousandth of the rest
    torch.autograd.backward(expected, incoming)
    torch.autograd.backward(ours, [t.float() for t in incoming])
    for a, b in zip(ours, expected):
        assert _relative(a.detach(), b.detach()) < RELATIVE
    for index in WANTED:
        assert fast[index].grad is not None and slow[index].grad is not None
        assert _relative(fast[index].grad, slow[index].grad) < RELATIVE, index


def test_a_collapsed_blend_gives_finite_gradients() -> None:
    scene = [t.float() for t in _scene(1, 2)]
    scene[0] = torch.tensor([[0.5, 0.5]])
    scene[1] = torch.zeros(2, 3, 4)
    scene[1][0, :, :3], scene[1][1, :, :3] = torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    leaves = [t.requires_grad_(i in WANTED) for i, t in enumerate(scene)]
    means, covariances, normals = _pose(leaves)
    (means.sum() + covariances.sum()).backward()
    assert all(t.isfinite().all() for t in (means, covariances, normals))
    assert all(leaves[i].grad.isfinite().all() for i in WANTED if leaves[i].grad is not None)


def test_a_nan_affects_its_gaussian_only() -> None:
    scene = [t.float() for t in _scene(4, 3)]
    scene[2][1, 0] = math.nan
    means, covariances, _ = _pose(scene)
    assert means[1].isnan().any() and covariances.isfinite().all()
    assert means[[0, 2, 3]].isfinite().all()
