"""The lifter's weights refined by gradient steps on the likelihood of its vectors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from rnd_trainer.estimating.lifted import PARENTS, REST_OFFSETS
from rnd_trainer.estimating.lifter import REACH

from .errors import ErrorModel
from .motions import Clips
from .network import LifterNetwork, negative_log_likelihood
from .synthesis import Batch, batch

WINDOWS, FRAMES = 48, 24
"""of a step: windows, and frames of each"""
RATE = 8e-5
POSITIONS = 10.0
"""weight of the joints' mean distance in metres beside the likelihood"""
ROLLS = 0.5
"""weight of the rolls' likelihood"""
MEMORY = 0.95
"""of the exponential mean of the weights"""
_SEED = 530


def refine(
    network: LifterNetwork, clips: Clips, errors: ErrorModel, steps: int, on_step: Callable[[int, float], None]
) -> LifterNetwork:
    """The exponential mean of the weights over ``steps`` of Adam from those of ``network``."""
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(MEMORY))
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 20) * 0.5 * (1 + np.cos(np.pi * step / steps))
        loss = loss_of(network, batch(clips, errors, WINDOWS, FRAMES + 2 * REACH, np.random.default_rng([_SEED, step])))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        average.update_parameters(network)
        on_step(step + 1, float(loss.detach()))
    refined: LifterNetwork = average.module.eval()  # type: ignore[assignment]
    return refined


def loss_of(network: LifterNetwork, made: Batch) -> Tensor:
    """Mean over frames of the likelihoods' means and of the distance of the joints."""
    unit, kappa = network(torch.from_numpy(made.inputs))
    target = torch.from_numpy(made.targets[:, REACH:-REACH])
    each = negative_log_likelihood(unit, kappa, target).mean((0, 1))
    apart = (rest_joints(unit) - rest_joints(target)).norm(dim=-1).mean()
    return each[:21].mean() + ROLLS * each[21:].mean() + POSITIONS * apart


def rest_joints(vectors: Tensor) -> Tensor:
    """Joints [..., 22, 3] of the mean body's bones with the first 21 of ``vectors`` [..., 42, 3], from the pelvis."""
    lengths = torch.tensor(REST_OFFSETS[1:]).norm(dim=-1).to(vectors)
    joints = [torch.zeros_like(vectors[..., 0, :])]
    for bone, parent in enumerate(PARENTS[1:]):
        joints.append(joints[parent] + lengths[bone] * vectors[..., bone, :])
    return torch.stack(joints, -2)
