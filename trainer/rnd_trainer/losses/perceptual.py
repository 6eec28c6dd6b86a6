"""Perceptual image distances: LPIPS v0.1 with AlexNet, SqueezeNet 1.1 or VGG16, and their feature maps.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric".
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from rnd_runtime.core.errors import InputError, first_line
from rnd_runtime.core.files import existing_file

from .perceptual_nets import BACKBONES, Backbone, Tensors

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation as LPIPS applies them, to images in −1…1"""
EPSILON = 1e-10
"""LPIPS adds it to the length of a feature vector, so that a dead cell gives zero"""


@dataclass(frozen=True, eq=False)
class Perceptual:
    """A distance between sRGB images; what it may be called is ``backbone`` and ``is_lpips``."""

    network: Backbone
    layers: int  # feature maps that the file's tensors reach; all of the network's, or its first few
    weights: Tensors
    heads: tuple[Tensor, ...]  # [1, C, 1, 1] for each layer; empty if the file has none
    file: Path
    sha256: str  # of the weights' file

    @property
    def backbone(self) -> str:
        """``alexnet``, ``squeezenet1_1``, ``vgg16``, or such as ``vgg16[:2]`` where only two blocks are there."""
        whole = self.layers == len(self.network.blocks)
        return self.network.name if whole else f"{self.network.name}[:{self.layers}]"

    @property
    def is_lpips(self) -> bool:
        """Whether the distance is LPIPS: a sum over the first few layers only is a distance, not that one."""
        return bool(self.heads) and self.layers == len(self.network.blocks)

    @property
    def smallest(self) -> int:
        """Pixels that an image needs along each side."""
        return self.network.smallest[self.layers - 1]

    @property
    def grids(self) -> tuple[tuple[int, float], ...]:
        """(stride, offset) in pixels of each feature map: cell j is centred at x = stride · j + offset, rows alike.

        Pixel centres are at +0.5. Valid convolutions move the offset, so cells do not share the image's borders.
        """
        stride, offset, grids = 1, 0.5, []
        for block in self.network.blocks[: self.layers]:
            for step in block:
                offset += stride * ((step.size - 1) / 2 - step.padding)
                stride *= step.stride
            grids.append((stride, offset))
        return tuple(grids)

    def features(self, image_srgb: Tensor) -> list[Tensor]:
        """Feature maps [C, h, w] ≥ 0 of an image [H, W, 3] in 0…1, shallow first; differentiable.

        Raises:
            InputError: the image is smaller than the network's first cell at its deepest layer.
        """
        assert image_srgb.ndim == 3 and image_srgb.shape[2] == 3, image_srgb.shape
        height, width = image_srgb.shape[:2]
        if min(height, width) < self.smallest:
            raise InputError(
                f"image for {self.backbone}",
                expected=f"at least {self.smallest} × {self.smallest} pixels",
                got=f"{width} × {height}",
            )
        shift, scale = image_srgb.new_tensor(SHIFT), image_srgb.new_tensor(SCALE)
        x = ((2 * image_srgb - 1 - shift) / scale).permute(2, 0, 1)[None]
        maps = []
        for block in self.network.blocks[: self.layers]:
            for step in block:
                x = step(x, self.weights)
            maps.append(x[0])
        return maps

    def __call__(self, image_srgb: Tensor, target_srgb: Tensor) -> Tensor:
        """The distance of two images [H, W, 3] in 0…1, a scalar; zero for equal ones; differentiable.

        Unit features, squared differences weighted by the heads, mean over cells, sum over layers (eq. 1).

        Raises:
            InputError: the file has no heads, or the images are too small.
        """
        assert image_srgb.shape == target_srgb.shape, (image_srgb.shape, target_srgb.shape)
        if not self.heads:
            raise InputError(
                "perceptual weights as a distance",
                expected=f"LPIPS heads lin0.weight to lin{self.layers - 1}.weight",
                got=f"{self.backbone} without heads",
                file=self.file,
            )
        pairs = zip(self.features(image_srgb), self.features(target_srgb), self.heads)
        return torch.stack([_layer_distance(a, b, head) for a, b, head in pairs]).sum()

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Perceptual:
        """The same distance for images on ``device`` or of ``dtype``; files are read as float32 on the CPU."""
        weights = {name: tensor.to(device=device, dtype=dtype) for name, tensor in self.weights.items()}
        heads = tuple(head.to(device=device, dtype=dtype) for head in self.heads)
        return dataclasses.replace(self, weights=weights, heads=heads)


def networks_sha256(*networks: Perceptual | None) -> str | None:
    """Of the files of ``networks``, each once; None where there is none."""
    return " ".join(dict.fromkeys(network.sha256 for network in networks if network is not None)) or None


def networks_by_role(perceptual: Perceptual | None, features: Perceptual | None) -> dict[str, str | None]:
    """Which network LPIPS is of and whose features L_gc compares: what else they could be is another training."""
    return {"lpips": networks_sha256(perceptual), "consistency": networks_sha256(features)}


def load_features(path: Path | None) -> Perceptual | None:
    """The network of ``--consistency-weights``, whole or its first few blocks; None where none is named."""
    return None if path is None else load_perceptual(path)


def load_lpips(path: Path | None) -> Perceptual | None:
    """The network of ``--perceptual-weights``, which must be whole and have its heads; None where none is named."""
    if path is None:
        return None
    perceptual = load_perceptual(path)
    if not perceptual.is_lpips:
        raise InputError(
            "--perceptual-weights", expected="a whole network with LPIPS heads", got=perceptual.backbone, file=path
        )
    return perceptual


def load_perceptual(path: str | Path) -> Perceptual:
    """Read a network, and LPIPS heads if there are any, from ``.safetensors`` or torchvision's ``.pth``.

    The network is known by its tensors ``features.*``, which must be all of one, or of its first few blocks;
    ``linK.weight`` [1, C, 1, 1] is the head of the K-th layer. Other tensors (``classifier.*``) are passed over.

    Raises:
        InputError: no file, cut short, not of weights alone, another network, some heads without the others,
            or numbers that are not finite.
    """
    path = existing_file(path, what="perceptual weights")
    tensors = {
        name: tensor.detach().float().contiguous()
        for name, tensor in _read(path).items()
        if name.startswith(("features.", "lin"))
    }
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(name, expected="finite numbers", got="NaN or infinity", file=path)
    weights = {name: tensor for name, tensor in tensors.items() if name.startswith("features.")}
    network, layers = _recognised(weights, path)
    heads = _heads(tensors, network, layers, path)
    with path.open("rb") as stream:
        sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    return Perceptual(network, layers, weights, heads, path, sha256)


def _read(path: Path) -> Tensors:
    suffix = path.suffix.lower()
    if suffix not in (".safetensors", ".pth"):
        raise InputError("perceptual weights", expected=".safetensors or .pth", got=suffix or "no suffix", file=path)
    try:
        if suffix == ".safetensors":
            return load_file(path)
        # torchvision publishes its networks as nothing else; weights_only builds tensors and runs no code
        state = torch.load(path, map_location="cpu", weights_only=True)  # noqa: TID251
    except Exception as error:  # an unpickler answers broken bytes with whatever it stumbles over
        raise InputError(f"not a whole {suffix} file of weights", got=first_line(error), file=path) from error
    if not isinstance(state, dict):
        raise InputError("perceptual weights", expected="a dictionary of tensors", got=type(state).__name__, file=path)
    for name, value in state.items():
        if not isinstance(value, Tensor):
            got = f"dict with {name}: {type(value).__name__}"
            raise InputError("perceptual weights", expected="a dictionary of tensors", got=got, file=path)
    return {str(name): value for name, value in state.items()}


def _recognised(weights: Tensors, path: Path) -> tuple[Backbone, int]:
    """The network, and how many of its blocks these tensors are."""
    found = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for network in BACKBONES:
        for layers in range(1, len(network.blocks) + 1):
            if found == network.shapes(layers):
                return network, layers
    nearest = max(BACKBONES, key=lambda network: len(found.items() & network.shapes().items()))
    expected = nearest.shapes()
    wrong = next((n for n in [*found, *expected] if found.get(n) != expected.get(n)), "none")
    raise InputError(
        "perceptual weights",
        expected=" or ".join(network.name for network in BACKBONES) + " as torchvision names them",
        got=f"{wrong} {found.get(wrong, 'missing')}" if found else "no features.*",
        file=path,
    )


def _heads(tensors: Tensors, network: Backbone, layers: int, path: Path) -> tuple[Tensor, ...]:
    """The heads of the first ``layers`` layers, or none at all if the file has none."""
    if not any(name.startswith("lin") for name in tensors):
        return ()
    heads = []
    for layer in range(layers):
        name, shape = f"lin{layer}.weight", (1, network.channels(layer), 1, 1)
        found = tuple(tensors[name].shape) if name in tensors else "none"
        if found != shape:
            raise InputError(f"LPIPS head {name}", expected=shape, got=found, file=path)
        heads.append(tensors[name])
    return tuple(heads)


def _layer_distance(a: Tensor, b: Tensor, head: Tensor) -> Tensor:
    """Weighted squared difference of the unit features of two maps [C, h, w], averaged over their cells."""
    return ((_unit(a) - _unit(b)).square() * head[0]).sum(dim=0).mean()


def _unit(features: Tensor) -> Tensor:
    return features / (torch.linalg.vector_norm(features, dim=0, keepdim=True) + EPSILON)
