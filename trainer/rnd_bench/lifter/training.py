"""Training of the lifter: resumable, by time or by steps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from rnd_runtime.core.files import atomic_path
from rnd_trainer.estimating.lifter import REACH

from .errors import ErrorModel
from .motions import Clips
from .network import LifterNetwork, negative_log_likelihood, rest_joints
from .synthesis import Batch, batch

WINDOWS, FRAMES = 40, 26 + 24
"""of a batch: windows, and frames of each; the first and last REACH only feed the convolutions"""
RATE = 1.5e-3
POSITIONS = 10.0
"""weight of the joints' mean distance in metres beside the likelihood"""
ROLLS = 0.5
"""weight of the rolls' likelihood"""
MEMORY = 0.998
"""of the exponential mean of the weights"""
STATE = "state.safetensors"
_SEED = 53


def loss_of(network: LifterNetwork, made: Batch) -> Tensor:
    """Mean over frames of the likelihoods' means and of the distance of the joints."""
    unit, kappa = network(torch.from_numpy(made.inputs))
    target = torch.from_numpy(made.targets[:, REACH:-REACH])
    each = negative_log_likelihood(unit, kappa, target).mean((0, 1))
    apart = (rest_joints(unit) - rest_joints(target)).norm(dim=-1).mean()
    return each[:21].mean() + ROLLS * each[21:].mean() + POSITIONS * apart


def train(
    clips: Clips, errors: ErrorModel, folder: Path, steps: int, on_step: Callable[[int, float], None], every: int = 500
) -> LifterNetwork:
    """Train for ``steps``; a state is written to ``folder`` every so many, and training goes on from the newest."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(_SEED)
    network = LifterNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=0.01)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(MEMORY), use_buffers=True)
    state, first = folder / STATE, 0
    if state.exists():
        first = _restore(state, network, average, optimiser)
    mean = 0.0
    for step in range(first, steps):
        rng = np.random.default_rng([_SEED, step])
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 200) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))
        loss = loss_of(network, batch(clips, errors, WINDOWS, FRAMES, rng))
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        average.update_parameters(network)
        mean = float(loss.detach()) if step == first else 0.98 * mean + 0.02 * float(loss.detach())
        on_step(step + 1, mean)
        if (step + 1) % every == 0 or step + 1 == steps:
            _store(state, network, average, optimiser, step + 1)
    return average.module.eval()


def _store(path: Path, network: LifterNetwork, average: AveragedModel, optimiser: Optimizer, step: int) -> None:
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in average.state_dict().items()}
    for number, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"step": str(step)})


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def load_average(folder: Path) -> LifterNetwork:
    """The mean network of the state in ``folder``."""
    average = AveragedModel(LifterNetwork(), use_buffers=True)
    average.load_state_dict(_part(load_file(folder / STATE), "average."))
    network: LifterNetwork = average.module.eval()  # type: ignore[assignment]
    return network


def _restore(path: Path, network: LifterNetwork, average: AveragedModel, optimiser: Optimizer) -> int:
    tensors = load_file(path)
    network.load_state_dict(_part(tensors, "network."))
    average.load_state_dict(_part(tensors, "average."))
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in _part(tensors, "optimiser.").items():
        number, what = name.split(".")
        moments.setdefault(int(number), {})[what] = value
    optimiser.load_state_dict({"state": moments, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(moments[0]["step"])
