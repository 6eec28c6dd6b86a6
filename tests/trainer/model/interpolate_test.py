"""The compiled interpolation against plain indexing, forward and by gradient."""

from __future__ import annotations

import torch

from rnd_trainer.model.interpolate import NodeInterpolation

FLOAT32_SUM = 1e-6  # four products of numbers near 1


def test_values_and_gradients_equal_plain_indexing() -> None:
    generator = torch.Generator().manual_seed(0)
    nodes, count = 40, 300
    neighbours = torch.randint(0, nodes - 3, (count, 4), generator=generator)  # three unused nodes
    weights = torch.rand(count, 4, generator=generator)
    values = torch.randn(nodes, 7, generator=generator)
    incoming = torch.randn(count, 7, generator=generator)

    fast = values.clone().requires_grad_()
    slow = values.double().requires_grad_()
    out = NodeInterpolation(neighbours, weights, nodes)(fast)
    expected = (slow[neighbours] * weights[..., None].double()).sum(1)
    out.backward(incoming)
    expected.backward(incoming.double())

    assert fast.grad is not None and slow.grad is not None
    assert (out - expected).abs().max() < FLOAT32_SUM * 4
    assert (fast.grad - slow.grad).abs().max() < FLOAT32_SUM * 100  # a node is read by about forty Gaussians
    assert (fast.grad[-3:] == 0).all()


def test_double_precision_uses_torch() -> None:
    neighbours, weights = torch.tensor([[0, 1], [1, 1]]), torch.tensor([[0.25, 0.75], [0.5, 0.5]])
    values = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    out = NodeInterpolation(neighbours, weights, 2)(values)
    assert out.dtype == torch.float64
    assert out[:, 0].tolist() == [2.5, 3.0]
