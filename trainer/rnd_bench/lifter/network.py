"""The lifter's network: convolutions over time, and the likelihood of unit vectors."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rnd_runtime.core.files import atomic_path
from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.lifter import CHANNELS, REACH

VECTORS = 2 * (len(JOINTS) - 1)
WIDTH, WIDER, KERNEL = 320, 3, 7
DILATIONS = (1, 1, 2, 2, 1)
"""of the blocks, which together look ``REACH`` frames ahead and back"""
DROPPED = 0.1
OUTPUTS = ("directions", "concentrations")
_LIMITS = (0.5, 4000.0)  # of κ, rad⁻²
assert sum(DILATIONS) * (KERNEL // 2) == REACH


class Block(nn.Module):
    """A convolution over time in each channel, then a hidden layer in each frame: [B, T, W] to [B, T − 2·reach, W].

    Source: Liu et al. 2022, A ConvNet for the 2020s.
    """

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.reach = KERNEL // 2 * dilation
        self.over_time = nn.Conv1d(width, width, KERNEL, dilation=dilation, groups=width)
        self.norm = nn.LayerNorm(width)
        self.first, self.second = nn.Linear(width, WIDER * width), nn.Linear(WIDER * width, width)
        self.drop = nn.Dropout(DROPPED)

    def forward(self, frames: Tensor) -> Tensor:
        seen = self.norm(self.over_time(frames.transpose(1, 2)).transpose(1, 2))
        return frames[:, self.reach : -self.reach] + self.second(self.drop(F.gelu(self.first(seen))))


class LifterNetwork(nn.Module):
    """Inputs [B, T + 2·REACH, CHANNELS] to unit vectors [B, T, 42, 3] and concentrations [B, T, 42], rad⁻²."""

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.enter = nn.Linear(CHANNELS, width)
        self.drop = nn.Dropout(DROPPED)
        self.blocks = nn.ModuleList(Block(width, dilation) for dilation in DILATIONS)
        self.norm, self.leave = nn.LayerNorm(width), nn.Linear(width, 4 * VECTORS)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        frames = self.enter(self.drop(features))
        for block in self.blocks:
            frames = block(frames)
        out = self.leave(self.norm(frames)).float().unflatten(-1, (VECTORS, 4))
        low, high = _LIMITS
        return unit_of(out[..., :3]), (low + out[..., 3].exp()).clamp(max=high)


def unit_of(vectors: Tensor) -> Tensor:
    """Vectors [..., 3] made unit."""
    return vectors / (vectors.square().sum(-1, keepdim=True) + 1e-6).sqrt()


def negative_log_likelihood(unit: Tensor, kappa: Tensor, target: Tensor) -> Tensor:
    """Of unit vectors ``target`` under von Mises-Fisher around ``unit``, without the constant log 2π, elementwise."""
    versine = 0.5 * (unit - target).square().sum(-1)
    return kappa * versine - kappa.log() + torch.log1p(-torch.exp(-2 * kappa))


def export(network: LifterNetwork, path: Path) -> None:
    """Write the network as ONNX: ``features`` [B, F, CHANNELS] to ``directions`` and ``concentrations``."""
    example = torch.zeros(2, 2 * REACH + 4, CHANNELS)
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch's newer exporter takes a hundred times as long
        torch.onnx.export(
            network,
            (example,),
            str(temporary),
            input_names=["features"],
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "batch", 1: f"{name}_frames"} for name in ("features", *OUTPUTS)},
            dynamo=False,
        )
        onnx.save(_halved(onnx.load(str(temporary))), str(temporary))


def _halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with its matrices stored in half precision, computed in single precision."""
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type == onnx.TensorProto.FLOAT and len(tensor.dims) == 2:
            name, half = tensor.name, onnx.numpy_helper.to_array(tensor).astype(np.float16)
            tensor.CopyFrom(onnx.numpy_helper.from_array(half, f"{name}_half"))
            casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model
