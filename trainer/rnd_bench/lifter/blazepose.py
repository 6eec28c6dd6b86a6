"""The landmark network in torch, on many crops at once: the same ONNX file that ``observing`` runs in onnxruntime."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F

from rnd_trainer.estimating.observing.landmarks import MIRRORED, POINTS, SIDE

_HEAT_SIDE, _HEAT_REACH, _MIN_HEAT = 64, 4, 0.5  # as of ``observing.landmarks``


class LandmarkGraph(nn.Module):
    """The convolutional graph of ``file``: crops [N, 3, 256, 256] in 0…1 to the five outputs, channels first.

    Its inside is computed in ``dtype``, its last layers in single precision.
    """

    def __init__(self, file: Path, device: torch.device, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        graph = onnx.load(str(file)).graph
        last = {name for node in graph.node for name in node.input if _is_end(node.op_type)}
        self.steps = []
        self.device, self.dtype = device, dtype
        constants = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
        for node in graph.node:
            held = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
            exact = node.op_type == "Conv" and bool(last & set(node.output))
            fixed = {n: self._constant(constants[n], node.op_type, exact) for n in node.input if n in constants}
            self.steps.append((node.op_type, list(node.input), node.output[0], held, fixed, exact))
        self.uses = {name: k for k, step in enumerate(self.steps) for name in step[1]}
        self.outputs = [output.name for output in graph.output]

    def _constant(self, array: np.ndarray, kind: str, exact: bool) -> Tensor | list[float]:
        if kind != "Conv":
            return list(array.ravel().tolist())
        weight = torch.from_numpy(array.copy()).to(self.device, torch.float32 if exact else self.dtype)
        return weight.contiguous(memory_format=torch.channels_last) if weight.ndim == 4 else weight

    @torch.no_grad()
    def forward(self, crops: Tensor) -> list[Tensor]:
        crops = crops.to(self.device, self.dtype).contiguous(memory_format=torch.channels_last)
        values = {"image": crops}
        for number, (kind, names, result, held, fixed, exact) in enumerate(self.steps):
            given = [fixed[n] if n in fixed else values[n] if n else None for n in names]
            values[result] = _run(kind, given, held, exact)
            for name in names:
                if self.uses.get(name) == number and name not in self.outputs:
                    values.pop(name, None)
        return [values[name] for name in self.outputs]


def _is_end(kind: str) -> bool:
    return kind in ("Transpose", "Reshape", "Sigmoid")


def _run(kind: str, given: list, held: dict, exact: bool) -> Tensor:
    x = given[0]
    if kind == "Conv":
        if exact:
            x = x.float()
        top, left, bottom, right = held.get("pads", [0, 0, 0, 0])
        pad = (top, left)
        if (top, left) != (bottom, right):
            x, pad = F.pad(x, (left, right, top, bottom)), (0, 0)
        bias = given[2] if len(given) > 2 else None
        return F.conv2d(x, given[1], bias, held["strides"], pad, held["dilations"], held.get("group", 1))
    if kind == "Clip":
        return x.clamp(given[1][0], given[2][0])
    if kind == "Add":
        return x + given[1]
    if kind == "MaxPool":
        return F.max_pool2d(x, held["kernel_shape"], held["strides"])
    if kind == "Resize":
        return F.interpolate(x, size=[int(n) for n in given[3][2:]], mode="bilinear", align_corners=False)
    if kind == "Pad":
        n = [int(v) for v in given[1]]
        return F.pad(x, (n[3], n[7], n[2], n[6], n[1], n[5]))
    if kind == "Sigmoid":
        return x.sigmoid()
    if kind == "Reshape":
        return x.permute(0, 2, 3, 1).flatten(1) if x.ndim == 4 else x
    if kind in ("Transpose", "Identity"):  # all is channels first here
        return x
    raise NotImplementedError(kind)


class Looks:
    """What the network sees in N crops.

    Attributes:
        points: [N, 33, 2] in the crops, pixels.
        metres: [N, 33, 3]; confidence: [N, 33]; score: [N].
        circle: [N, 2, 2] centre of the person and a point above, which span the next region, pixels.
    """

    def __init__(self, outputs: list[Tensor], mirrored: bool) -> None:
        rows = outputs[0].float().reshape(len(outputs[0]), -1, 5)
        places = _sharpened(rows[..., :2], outputs[3].float())
        metres = outputs[4].float().reshape(len(rows), -1, 3)[:, :POINTS]
        confidence = (rows[:, :POINTS, 3].sigmoid() * rows[:, :POINTS, 4].sigmoid()).clamp(0, 1)
        points, self.circle = places[:, :POINTS], places[:, POINTS : POINTS + 2]
        if mirrored:
            other = torch.from_numpy(MIRRORED).to(points.device)
            points, metres, confidence = points[:, other], metres[:, other], confidence[:, other]
            points = torch.stack([SIDE - points[..., 0], points[..., 1]], -1)
            metres = metres * metres.new_tensor([-1, 1, 1])
        self.points, self.metres, self.confidence = points, metres, confidence
        self.score = outputs[1].float().flatten()


def _sharpened(points: Tensor, heat: Tensor) -> Tensor:
    """``points`` [N, 39, 2] moved to the centre of heat [N, 39, 64, 64] around them where there is some."""
    step, reach = SIDE / _HEAT_SIDE, _HEAT_REACH
    cell = (points / step).trunc().long()
    inside = ((cell >= 0) & (cell < _HEAT_SIDE)).all(-1)
    around = torch.arange(-reach, reach + 1, device=points.device)
    columns, rows = cell[..., :1] + around, cell[..., 1:] + around
    known = ((rows >= 0) & (rows < _HEAT_SIDE))[..., :, None] & ((columns >= 0) & (columns < _HEAT_SIDE))[..., None, :]
    index = rows.clamp(0, _HEAT_SIDE - 1)[..., :, None] * _HEAT_SIDE + columns.clamp(0, _HEAT_SIDE - 1)[..., None, :]
    near = heat.flatten(2).gather(2, index.flatten(2)).reshape(index.shape).sigmoid() * known
    total = near.sum((-1, -2)).clamp(min=1e-9)
    centre = torch.stack([(near.sum(-2) * columns).sum(-1) / total, (near.sum(-1) * rows).sum(-1) / total], -1)
    hot = inside & (near.flatten(-2).amax(-1) >= _MIN_HEAT)
    return torch.where(hot[..., None], centre * step, points)
