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
"""ImageNet's mean and standard deviation, of images in −1…1"""
EPSILON = 1e-10
"""added to the length of a feature vector, as in LPIPS"""


@dataclass(frozen=True, eq=False)
class Perceptual:
    """Perceptual distance between sRGB images."""

    network: Backbone
    layers: int  # feature maps, all of the network's or the first few
    weights: Tensors
    heads: tuple[Tensor, ...]  # [1, C, 1, 1] per layer, or empty
    file: Path
    sha256: str  # of the weights' file

    @property
    def backbone(self) -> str:
        """``alexnet``, ``squeezenet1_1`` or ``vgg16``; ``vgg16[:2]`` is its first two blocks."""
        complete = self.layers == len(self.network.blocks)
        return self.network.name if complete else f"{self.network.name}[:{self.layers}]"

    @property
    def is_lpips(self) -> bool:
        """Whether the distance is LPIPS: all layers, with heads."""
        return bool(self.heads) and self.layers == len(self.network.blocks)

    @property
    def smallest(self) -> int:
        """Smallest image side in pixels."""
        return self.network.smallest[self.layers - 1]

    @property
    def grids(self) -> tuple[tuple[int, float], ...]:
        """(stride, offset) in pixels of each feature map: cell j is centred at stride · j + offset in x and y.

        Pixel centres are at +0.5.
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

        Computed in the weights' type, returned in the image's.

        Raises:
            InputError: the image is smaller than ``smallest``.
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
        weights_type = next(iter(self.weights.values())).dtype
        x = ((2 * image_srgb - 1 - shift) / scale).to(weights_type).permute(2, 0, 1)[None]
        maps = []
        for block in self.network.blocks[: self.layers]:
            for step in block:
                x = step(x, self.weights)
            maps.append(x[0].to(image_srgb.dtype))
        return maps

    def __call__(self, image_srgb: Tensor, target_srgb: Tensor) -> Tensor:
        """Distance of two images [H, W, 3] in 0…1, a differentiable scalar.

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
        """Copy for images on ``device`` or of ``dtype``."""
        weights = {name: tensor.to(device=device, dtype=dtype) for name, tensor in self.weights.items()}
        heads = tuple(head.to(device=device, dtype=dtype) for head in self.heads)
        return dataclasses.replace(self, weights=weights, heads=heads)

    def in_bfloat16(self) -> Perceptual:
        """Copy that convolves in bfloat16 where this CPU multiplies in it, in 0.55 of the time; elsewhere itself.

        The distance changes by a thousandth, its gradient by 0.12 of its length, at a cosine of 0.993.
        """
        capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
        if not capabilities.get("avx512_bf16", False):
            return self

        def converted(tensor: Tensor) -> Tensor:
            kind = torch.channels_last if tensor.ndim == 4 else torch.preserve_format
            return tensor.to(torch.bfloat16, memory_format=kind)

        return dataclasses.replace(self, weights={name: converted(tensor) for name, tensor in self.weights.items()})


def networks_sha256(*networks: Perceptual | None) -> str | None:
    """SHA-256 of the files of ``networks``, each once; None without networks."""
    return " ".join(dict.fromkeys(network.sha256 for network in networks if network is not None)) or None


def networks_by_role(perceptual: Perceptual | None, features: Perceptual | None) -> dict[str, str | None]:
    """SHA-256 of the networks of LPIPS and L_gc."""
    return {"lpips": networks_sha256(perceptual), "consistency": networks_sha256(features)}


def load_features(path: Path | None) -> Perceptual | None:
    """Network of ``--consistency-weights``, or its first blocks; None without a path."""
    return None if path is None else load_perceptual(path)


def load_lpips(path: Path | None) -> Perceptual | None:
    """Network of ``--perceptual-weights``, complete and with heads; None without a path."""
    if path is None:
        return None
    perceptual = load_perceptual(path)
    if not perceptual.is_lpips:
        raise InputError(
            "--perceptual-weights", expected="a whole network with LPIPS heads", got=perceptual.backbone, file=path
        )
    return perceptual


def load_perceptual(path: str | Path) -> Perceptual:
    """Read a network, and LPIPS heads if present, from ``.safetensors`` or torchvision's ``.pth``.

    The tensors ``features.*`` identify the network, or its first blocks; ``linK.weight`` [1, C, 1, 1] is the head of
    layer K. Other tensors are ignored.

    Raises:
        InputError: missing, truncated, an unknown network, incomplete heads, or numbers that are not finite.
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
    network, layers = _identify(weights, path)
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
        # torchvision's format; weights_only runs no code
        state = torch.load(path, map_location="cpu", weights_only=True)  # noqa: TID251
    except Exception as error:  # unpickling broken bytes raises any exception
        raise InputError(f"not a whole {suffix} file of weights", got=first_line(error), file=path) from error
    if not isinstance(state, dict):
        raise InputError("perceptual weights", expected="a dictionary of tensors", got=type(state).__name__, file=path)
    for name, value in state.items():
        if not isinstance(value, Tensor):
            got = f"dict with {name}: {type(value).__name__}"
            raise InputError("perceptual weights", expected="a dictionary of tensors", got=got, file=path)
    return {str(name): value for name, value in state.items()}


def _identify(weights: Tensors, path: Path) -> tuple[Backbone, int]:
    """The network, and the number of its blocks in ``weights``."""
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
    """Heads of the first ``layers`` layers, empty if the file has none."""
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
    """Weighted squared difference of the unit features of two maps [C, h, w], mean over cells."""
    return ((_unit(a) - _unit(b)).square() * head[0]).sum(dim=0).mean()


def _unit(features: Tensor) -> Tensor:
    return features / (torch.linalg.vector_norm(features, dim=0, keepdim=True) + EPSILON)
