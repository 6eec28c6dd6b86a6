"""The lifter's network: dilated convolutions over time, trained by the likelihood of unit vectors."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from rnd_runtime.core.files import atomic_path
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_OFFSETS
from rnd_trainer.estimating.lifter import CHANNELS, REACH

VECTORS = 2 * (len(JOINTS) - 1)
_LIMITS = (0.5, 4000.0)  # of κ, rad⁻²


class LifterNetwork(nn.Module):
    """Inputs [B, T + 2·REACH, CHANNELS] to unit vectors [B, T, 42, 3] and concentrations [B, T, 42], rad⁻²."""

    def __init__(self, width: int = 256) -> None:
        super().__init__()
        self.first = nn.Conv1d(CHANNELS, width, 3)
        self.wide = nn.ModuleList(nn.Conv1d(width, width, 3, dilation=d) for d in (3, 9))
        self.narrow = nn.ModuleList(nn.Conv1d(width, width, 1) for _ in self.wide)
        self.frame = nn.Conv1d(CHANNELS, width, 1)
        self.last = nn.Conv1d(width, width, 1)
        self.head = nn.Conv1d(width, 4 * VECTORS, 1)
        self.norms = nn.ModuleList(nn.BatchNorm1d(width) for _ in range(2 * len(self.wide) + 2))
        nn.init.normal_(self.head.weight, std=0.02)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        x = features.transpose(1, 2)
        centre = x[:, :, REACH : x.shape[2] - REACH]
        norms = iter(self.norms)
        h = torch.relu(next(norms)(self.first(x)))
        for wide, narrow in zip(self.wide, self.narrow):
            reach = wide.dilation[0]
            g = torch.relu(next(norms)(wide(h)))
            h = h[:, :, reach : h.shape[2] - reach] + torch.relu(next(norms)(narrow(g)))
        h = torch.relu(next(norms)(self.last(h + self.frame(centre))))
        out = self.head(h).transpose(1, 2).unflatten(-1, (VECTORS, 4))
        unit = out[..., :3] / (out[..., :3].square().sum(-1, keepdim=True) + 1e-6).sqrt()
        low, high = _LIMITS
        return unit, (low + (3 + out[..., 3]).exp()).clamp(max=high)


def negative_log_likelihood(unit: Tensor, kappa: Tensor, target: Tensor) -> Tensor:
    """Of unit vectors ``target`` under von Mises-Fisher around ``unit``, without the constant log 2π, elementwise."""
    versine = 0.5 * (unit - target).square().sum(-1)
    return kappa * versine - kappa.log() + torch.log1p(-torch.exp(-2 * kappa))


def rest_joints(vectors: Tensor) -> Tensor:
    """Joints [..., 22, 3] of the mean body's bones with the first 21 of ``vectors`` [..., 42, 3], from the pelvis."""
    lengths = torch.tensor(REST_OFFSETS[1:]).norm(dim=-1).to(vectors)
    joints = [torch.zeros_like(vectors[..., 0, :])]
    for bone, parent in enumerate(PARENTS[1:]):
        joints.append(joints[parent] + lengths[bone] * vectors[..., bone, :])
    return torch.stack(joints, -2)


def export(network: LifterNetwork, path: Path) -> None:
    """Write the network as ONNX: ``features`` [B, F, CHANNELS] to ``directions`` and ``concentrations``."""
    was = network.training
    network.eval()
    example = torch.zeros(1, 2 * REACH + 4, CHANNELS)
    axes = {"features": {0: "batch", 1: "frames"}}
    with atomic_path(path) as temporary:
        torch.onnx.export(
            network,
            (example,),
            str(temporary),
            input_names=["features"],
            output_names=["directions", "concentrations"],
            dynamic_axes=axes,
            opset_version=17,
            dynamo=False,
        )
    network.train(was)
