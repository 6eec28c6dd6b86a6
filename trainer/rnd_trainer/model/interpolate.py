"""Interpolation from nodes to Gaussians, with a backward pass that gathers instead of scattering."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor, nn


class NodeInterpolation(nn.Module):
    """values [M, C] → Σ_k weights[n, k] · values[neighbours[n, k]], [N, C].

    The transpose is built once, so that both directions are deterministic gathers. Torch's backward of
    ``values[neighbours]`` scatters by element and costs more than the networks.

    Args:
        neighbours: [N, K] int64 node indices below ``nodes``.
        weights: [N, K] float32.
        nodes: M.
    """

    neighbours: Tensor
    weights: Tensor

    def __init__(self, neighbours: Tensor, weights: Tensor, nodes: int) -> None:
        super().__init__()
        self.register_buffer("neighbours", neighbours)
        self.register_buffer("weights", weights)
        self._transpose = _transpose(neighbours.numpy(), nodes)

    def forward(self, values: Tensor) -> Tensor:
        if values.is_cuda or values.dtype != torch.float32:  # the compiled kernels are for CPU training
            return (values[self.neighbours] * self.weights[..., None]).sum(dim=1)
        return _Interpolate.apply(values, self)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, plan: NodeInterpolation) -> Tensor:
        ctx.plan = plan
        table = np.ascontiguousarray(values.detach().numpy())
        return torch.from_numpy(_gather(table, plan.neighbours.numpy(), plan.weights.numpy()))

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        plan: NodeInterpolation = ctx.plan
        starts, order = plan._transpose
        weights = plan.weights.numpy().reshape(-1)
        return torch.from_numpy(_gather_transposed(grad.contiguous().numpy(), starts, order, weights)), None


def _transpose(neighbours: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices n·K + k that read each node, in CSR form: starts [M + 1], order [N·K]."""
    flat = neighbours.reshape(-1)
    order = np.argsort(flat, kind="stable")
    return np.searchsorted(flat[order], np.arange(nodes + 1)), order


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _gather(values, neighbours, weights):
    out = np.empty((neighbours.shape[0], values.shape[1]), np.float32)
    for n in numba.prange(neighbours.shape[0]):
        row = out[n]
        row[:] = np.float32(0)
        for k in range(neighbours.shape[1]):
            source, weight = values[neighbours[n, k]], weights[n, k]
            for c in range(values.shape[1]):
                row[c] += weight * source[c]
    return out


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _gather_transposed(grad, starts, order, weights):
    neighbours = weights.shape[0] // grad.shape[0]
    out = np.empty((starts.shape[0] - 1, grad.shape[1]), np.float32)
    for m in numba.prange(out.shape[0]):
        row = out[m]
        row[:] = np.float32(0)
        for entry in order[starts[m] : starts[m + 1]]:
            source, weight = grad[entry // neighbours], weights[entry]
            for c in range(grad.shape[1]):
                row[c] += weight * source[c]
    return out
