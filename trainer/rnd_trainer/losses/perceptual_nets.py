"""Convolutional networks of LPIPS: AlexNet, SqueezeNet 1.1 and VGG16, in blocks between its layers.

Tensors have torchvision's names. Krizhevsky 2014 (one column), Iandola et al. 2016, Simonyan and Zisserman 2015.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

Tensors = dict[str, Tensor]
Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Conv:
    """A convolution and its ReLU, ``features.<index>`` in the file."""

    name: str
    inputs: int
    outputs: int
    size: int = 3
    stride: int = 1
    padding: int = 0

    def shapes(self) -> Shapes:
        weight = (self.outputs, self.inputs, self.size, self.size)
        return {f"features.{self.name}.weight": weight, f"features.{self.name}.bias": (self.outputs,)}

    def __call__(self, x: Tensor, weights: Tensors) -> Tensor:
        weight, bias = weights[f"features.{self.name}.weight"], weights[f"features.{self.name}.bias"]
        return relu(conv2d(x, weight, bias, self.stride, self.padding))


@dataclass(frozen=True)
class Fire:
    """SqueezeNet's module: 1×1 to ``squeezed`` channels, then 1×1 and 3×3, concatenated to ``outputs``."""

    name: str
    inputs: int
    squeezed: int
    outputs: int
    size: int = 3
    stride: int = 1
    padding: int = 1

    def _parts(self) -> tuple[Conv, Conv, Conv]:
        half = self.outputs // 2
        return (
            Conv(f"{self.name}.squeeze", self.inputs, self.squeezed, 1),
            Conv(f"{self.name}.expand1x1", self.squeezed, half, 1),
            Conv(f"{self.name}.expand3x3", self.squeezed, half, self.size, padding=self.padding),
        )

    def shapes(self) -> Shapes:
        return {name: shape for part in self._parts() for name, shape in part.shapes().items()}

    def __call__(self, x: Tensor, weights: Tensors) -> Tensor:
        squeeze, narrow, wide = self._parts()
        x = squeeze(x, weights)
        return torch.cat([narrow(x, weights), wide(x, weights)], dim=1)


@dataclass(frozen=True)
class Pool:
    """Max pooling with stride 2; ``ceil`` keeps partial windows."""

    size: int
    ceil: bool = False
    stride: int = 2
    padding: int = 0

    def shapes(self) -> Shapes:
        return {}

    def __call__(self, x: Tensor, weights: Tensors) -> Tensor:
        return max_pool2d(x, self.size, self.stride, ceil_mode=self.ceil)


@dataclass(frozen=True)
class Backbone:
    """A network as blocks, each ending in a feature map of LPIPS."""

    name: str
    blocks: tuple[tuple[Conv | Fire | Pool, ...], ...]
    smallest: tuple[int, ...]  # smallest image side of the first k blocks, pixels

    def shapes(self, layers: int | None = None) -> Shapes:
        """Names and shapes of the tensors of all blocks, or of the first ``layers``."""
        steps = [step for block in self.blocks[:layers] for step in block]
        return {name: shape for step in steps for name, shape in step.shapes().items()}

    def channels(self, layer: int) -> int:
        """Channels of the feature map of block ``layer``."""
        last = self.blocks[layer][-1]
        assert not isinstance(last, Pool), "LPIPS reads after a ReLU"
        return last.outputs


def _vgg_block(inputs: int, outputs: int, *indices: int) -> tuple[Conv, ...]:
    widths = [inputs] + [outputs] * len(indices)
    return tuple(Conv(str(i), before, outputs, padding=1) for i, before in zip(indices, widths))


BACKBONES = (
    Backbone(
        "alexnet",
        (
            (Conv("0", 3, 64, 11, 4, 2),),
            (Pool(3), Conv("3", 64, 192, 5, 1, 2)),
            (Pool(3), Conv("6", 192, 384, padding=1)),
            (Conv("8", 384, 256, padding=1),),
            (Conv("10", 256, 256, padding=1),),
        ),
        (7, 15, 31, 31, 31),
    ),
    Backbone(
        "squeezenet1_1",
        (
            (Conv("0", 3, 64, 3, 2),),
            (Pool(3, ceil=True), Fire("3", 64, 16, 128), Fire("4", 128, 16, 128)),
            (Pool(3, ceil=True), Fire("6", 128, 32, 256), Fire("7", 256, 32, 256)),
            (Pool(3, ceil=True), Fire("9", 256, 48, 384)),
            (Fire("10", 384, 48, 384),),
            (Fire("11", 384, 64, 512),),
            (Fire("12", 512, 64, 512),),
        ),
        (3, 5, 9, 17, 17, 17, 17),
    ),
    Backbone(
        "vgg16",
        (
            _vgg_block(3, 64, 0, 2),
            (Pool(2), *_vgg_block(64, 128, 5, 7)),
            (Pool(2), *_vgg_block(128, 256, 10, 12, 14)),
            (Pool(2), *_vgg_block(256, 512, 17, 19, 21)),
            (Pool(2), *_vgg_block(512, 512, 24, 26, 28)),
        ),
        (1, 2, 4, 8, 16),
    ),
)
