"""The compiled shading and filter against their plain torch versions in float64, forward and by gradient."""

from __future__ import annotations

import math

import pytest
import torch

from rnd_trainer.render.probe import Texels
from rnd_trainer.render.shading import shade

FORWARD = 1e-4  # relative L2: sin²θ_h = 1 − cos² loses 1e-7 of up to 1/α² = 1.5e4 at a mirror-like peak
GRADIENT = 2e-4  # GGX's derivative has cancelling terms of up to 1/α²


def _relative(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    return float((ours.double() - theirs).norm() / theirs.norm())


def _scene(count: int, texels: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)

    def unit(*shape: int) -> torch.Tensor:
        return torch.nn.functional.normalize(torch.randn(*shape, 3, dtype=torch.float64, generator=generator), dim=-1)

    normals, view, directions = unit(count), unit(count), unit(texels)
    view = torch.where((normals * view).sum(-1, keepdim=True) < -0.2, -view, view)
    uniform = torch.rand(count, 4, dtype=torch.float64, generator=generator)
    albedo, roughness = 0.8 * uniform[:, :3], 0.05 + 0.97 * uniform[:, 3]  # some beyond the clamp
    albedo[::4] *= 0.03  # darker than F0
    visibility = torch.rand(count, texels, dtype=torch.float64, generator=generator) - 0.1
    power = torch.rand(texels, 3, dtype=torch.float64, generator=generator)
    return [normals, view, albedo, roughness, visibility, directions, power]


@pytest.mark.parametrize(("count", "texels"), [(300, 40), (5, 1), (1, 7)])
def test_fused_shading_equals_the_float64_formula(count: int, texels: int) -> None:
    scene = _scene(count, texels)
    wanted = (0, 2, 3, 6)
    slow = [t.clone().requires_grad_(i in wanted) for i, t in enumerate(scene)]
    fast = [t.float().requires_grad_(i in wanted) for i, t in enumerate(scene)]
    expected = shade(*slow[:5], Texels(slow[5], slow[6]))
    ours = shade(*fast[:5], Texels(fast[5], fast[6]))
    incoming = torch.randn(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    expected.backward(incoming)
    ours.backward(incoming.float())
    assert _relative(ours.detach(), expected.detach()) < FORWARD
    for index in wanted:
        assert fast[index].grad is not None and slow[index].grad is not None
        if slow[index].grad.norm() == 0:
            assert fast[index].grad.norm() == 0
        else:
            assert _relative(fast[index].grad, slow[index].grad) < GRADIENT


def test_fused_shading_has_the_same_bits_for_any_thread_count() -> None:
    import numba

    scene = [t.float() for t in _scene(200, 33)]
    results = []
    before = numba.get_num_threads()
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            power = scene[6].clone().requires_grad_()
            shade(*scene[:5], Texels(scene[5], power)).square().sum().backward()
            results.append(power.grad)
    finally:
        numba.set_num_threads(before)
    assert torch.equal(*results)


def test_a_nan_is_propagated() -> None:
    scene = [t.float() for t in _scene(4, 8)]
    scene[0][2] = math.nan
    radiance = shade(*scene[:5], Texels(scene[5], scene[6]))
    assert radiance[2].isnan().all() and radiance[[0, 1, 3]].isfinite().all()
