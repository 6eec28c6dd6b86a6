"""The lifter's network: two wide hidden layers over some frames each, and the likelihood of unit vectors."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from rnd_runtime.core.files import atomic_path
from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.lifter import CHANNELS, REACH

VECTORS = 2 * (len(JOINTS) - 1)
STAGES = 2
HALF = REACH // STAGES
"""frames that each stage looks ahead and back"""
SIZES = (4 * CHANNELS, *(STAGES - 1) * (5 * 3 * VECTORS + 2 * CHANNELS,))
"""inputs of the stages"""
COMPONENTS, HIDDEN = 256, 1536
OUTPUTS = ("directions", "concentrations")
_LIMITS = (0.5, 4000.0)  # of κ, rad⁻²


class Stage(nn.Module):
    """A hidden layer on main components, beside a linear map: [..., size] to [..., 42, outputs]."""

    def __init__(self, size: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.main = nn.Linear(size, COMPONENTS)
        self.first = nn.Linear(COMPONENTS, hidden)
        self.skip = nn.Linear(size, outputs * VECTORS)
        self.head = nn.Linear(hidden, outputs * VECTORS, bias=False)
        self.outputs = outputs

    def hidden(self, inputs: Tensor) -> Tensor:
        """Hidden units [..., hidden]."""
        return torch.relu(self.first(self.main(inputs)))

    def forward(self, inputs: Tensor) -> Tensor:
        out = self.head(self.hidden(inputs)) + self.skip(inputs)
        return out.unflatten(-1, (VECTORS, self.outputs))


class LifterNetwork(nn.Module):
    """Inputs [B, T + 2·REACH, CHANNELS] to unit vectors [B, T, 42, 3] and concentrations [B, T, 42], rad⁻².

    The first stage guesses vectors from landmarks, each later one from landmarks and the last one's vectors over time.
    """

    def __init__(self, hidden: int = HIDDEN) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            Stage(size, hidden, outputs) for size, outputs in zip(SIZES, (*(STAGES - 1) * (3,), 4))
        )

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        out = self.stages[-1](self.inputs_of(STAGES - 1, features))
        low, high = _LIMITS
        return unit_of(out[..., :3]), (low + out[..., 3].exp()).clamp(max=high)

    def inputs_of(self, stage: int, features: Tensor) -> Tensor:
        """What ``stage`` sees [B, T - 2·HALF·(stage + 1), SIZES[stage]] of inputs [B, T, CHANNELS]."""
        if stage == 0:
            near = torch.stack([_at(features, k) for k in (-2, 0, 2)]).mean(0)
            wide = torch.stack([_at(features, k) for k in range(-HALF, HALF + 1, 3)]).mean(0)
            motion = 2 * (_at(features, 5) - _at(features, -5))
            return torch.cat([_at(features, 0), near, wide, motion], -1)
        guess = unit_of(self.stages[stage - 1](self.inputs_of(stage - 1, features))).flatten(-2)
        inner = features[:, stage * HALF : -stage * HALF]
        near = (_at(inner, -2) + _at(inner, 2)) / 2
        return torch.cat([*(_at(guess, k) for k in (-HALF, -2, 0, 2, HALF)), _at(inner, 0), near], -1)


def _at(values: Tensor, offset: int) -> Tensor:
    """``values`` [B, T, n] without HALF frames at each end, moved by ``offset`` frames."""
    return values[:, HALF + offset : (offset - HALF) or None]


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
