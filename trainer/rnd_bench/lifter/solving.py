"""The lifter's weights in closed form: hidden units from pairs of samples, then ridge regression, stage by stage.

Source: Bolager et al. 2023, Sampling weights of deep neural networks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_trainer.estimating.lifter import REACH

from .errors import ErrorModel
from .motions import Clips, Generator
from .network import COMPONENTS, HIDDEN, VECTORS, LifterNetwork, Stage, unit_of
from .synthesis import batch

Floats = NDArray[np.float64]

WINDOWS, FRAMES, EVERY = 150, 24, 4
"""of a batch: windows, frames of each, and frames from one sample to the next"""
RIDGE, RIDGE_KAPPA = 1e-3, 0.05
"""weights of squared weights, beside the mean over samples of squared errors"""
FRESH = 10
"""batches of the concentrations: one for so many of the last stage"""
_EULER = 0.5772156649
_SEED = 53


class _Sums:
    """Normal equations of a stage's last layer: of its hidden units, its scaled inputs and one."""

    def __init__(self, stage: Stage, mean: Tensor, scale: Tensor, outputs: int) -> None:
        self.stage, self.mean, self.scale = stage, mean, scale
        size = stage.first.out_features + stage.skip.in_features + 1
        self.gram, self.right = np.zeros((size, size)), np.zeros((size, outputs))

    def rows(self, inputs: Tensor) -> Tensor:
        hidden = self.stage.hidden(inputs)
        return torch.cat([hidden, (inputs - self.mean) / self.scale, torch.ones(len(inputs), 1)], 1)

    def add(self, inputs: Tensor, target: Tensor) -> None:
        rows = self.rows(inputs)
        self.gram += (rows.T @ rows).numpy()
        self.right += (rows.T @ target).numpy()

    def weights(self, ridge: float) -> Tensor:
        """[hidden + inputs + 1, outputs] with each weight measured in its row's deviation."""
        keep = ridge * np.maximum(np.diag(self.gram), 1e-3 * self.gram[-1, -1])
        keep[-1] = 0
        return torch.from_numpy(np.linalg.solve(self.gram + np.diag(keep), self.right)).float()

    def place(self, weights: Tensor, values: slice) -> None:
        """Put ``weights`` into ``values`` of the outputs of every vector."""
        stage, hidden = self.stage, self.stage.first.out_features
        each = weights.T.reshape(VECTORS, -1, len(weights))
        linear = each[:, :, hidden:-1] / self.scale
        stage.head.weight.view(VECTORS, stage.outputs, -1)[:, values] = each[:, :, :hidden]
        stage.skip.weight.view(VECTORS, stage.outputs, -1)[:, values] = linear
        stage.skip.bias.view(VECTORS, stage.outputs)[:, values] = each[:, :, -1] - linear @ self.mean


@torch.no_grad()
def solve(
    clips: Clips, errors: ErrorModel, batches: int, on_batch: Callable[[int], None], hidden: int = HIDDEN
) -> LifterNetwork:
    """Least squares of unit vectors, then of log concentrations, over random batches of motion.

    Args:
        batches: of each of the two stages.
        on_batch: called with the number of batches done.
    """
    network = LifterNetwork(hidden).eval()
    for number, stage in enumerate(network.stages):
        assert isinstance(stage, Stage)
        inputs, target = _samples(network, number, clips, errors, 0)
        mean, scale = inputs.mean(0), inputs.std(0) + 0.05
        scaled = (inputs - mean) / scale
        stage.main.weight.copy_(torch.linalg.eigh(scaled.T @ scaled)[1][:, -COMPONENTS:].T / scale)
        stage.main.bias.copy_(-stage.main.weight @ mean)
        _sample_units(stage, stage.main(inputs), target, np.random.default_rng([_SEED, number]))
        sums = _Sums(stage, mean, scale, 3 * VECTORS)
        for k in range(batches):
            sums.add(*_samples(network, number, clips, errors, k + 1))
            on_batch(number * batches + k + 1)
        sums.place(sums.weights(RIDGE), slice(0, 3))
    _concentrate(network, sums, clips, errors, batches)
    return network


def _samples(
    network: LifterNetwork, stage: int, clips: Clips, errors: ErrorModel, number: int
) -> tuple[Tensor, Tensor]:
    """What ``stage`` sees [N, inputs] and targets [N, 126] of one batch."""
    made = batch(clips, errors, WINDOWS, FRAMES + 2 * REACH, np.random.default_rng([_SEED, stage, number]))
    inputs = network.inputs_of(stage, torch.from_numpy(made.inputs))
    beside = (made.inputs.shape[1] - inputs.shape[1]) // 2
    target = torch.from_numpy(made.targets)[:, beside : beside + inputs.shape[1]]
    return inputs[:, ::EVERY].flatten(0, 1), target[:, ::EVERY].flatten(0, 1).flatten(1)


def _sample_units(stage: Stage, scaled: Tensor, target: Tensor, rng: Generator) -> None:
    """Units that rise from one sample to another; pairs are likelier the steeper their targets differ."""
    count, hidden = len(scaled), stage.first.out_features
    pairs = rng.integers(count, size=(8 * hidden, 2))
    apart = (scaled[pairs[:, 1]] - scaled[pairs[:, 0]]).norm(dim=1).numpy() + 1e-3
    steep = (target[pairs[:, 1]] - target[pairs[:, 0]]).norm(dim=1).numpy() / apart
    chosen = pairs[rng.choice(len(pairs), hidden, replace=False, p=steep / steep.sum())]
    step = scaled[chosen[:, 1]] - scaled[chosen[:, 0]]
    stage.first.weight.copy_(step / (step.square().sum(1, keepdim=True) + 1e-6))
    stage.first.bias.copy_(-(stage.first.weight * scaled[chosen[:, 0]]).sum(1))


def _concentrate(network: LifterNetwork, sums: _Sums, clips: Clips, errors: ErrorModel, batches: int) -> None:
    """Regress log κ over batches that the vectors have not seen, then scale each vector's by maximum likelihood."""
    last = len(network.stages) - 1
    fresh = _Sums(sums.stage, sums.mean, sums.scale, VECTORS)
    count = max(batches // FRESH, 2)
    for k in range(count):
        inputs, target = _samples(network, last, clips, errors, batches + k + 1)
        fresh.add(inputs, -(_versine(sums.stage, inputs, target) + 1e-4).log() - _EULER)  # κ(1 − cos) is exponential
    weights = fresh.weights(RIDGE_KAPPA)
    inputs, target = _samples(network, last, clips, errors, batches + count + 1)
    kappa = (fresh.rows(inputs) @ weights).exp()
    weights[-1] -= (kappa * _versine(sums.stage, inputs, target)).mean(0).log()
    fresh.place(weights, slice(3, 4))


def _versine(stage: Stage, inputs: Tensor, target: Tensor) -> Tensor:
    """1 − cos [N, 42] between the vectors that ``stage`` gives and the targets."""
    return 0.5 * (unit_of(stage(inputs)[..., :3]) - target.unflatten(-1, (VECTORS, 3))).square().sum(-1)
