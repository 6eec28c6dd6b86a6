"""Estimated albedo from a network: the base colour of each pixel, up to brightness and tint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import to_bytes

from .networks import ImageNetwork

_RANGE = (-0.1, 1.1)
"""of a network without a final sigmoid, whose output is clipped to 0 … 1"""
_MAX_OUTSIDE = 0.05
"""share of the person's values outside ``_RANGE`` above which the output is no sRGB image"""


def albedo_network(path: Path) -> ImageNetwork:
    """Network of the ONNX file ``path`` with three output channels."""
    return ImageNetwork(path, outputs=(3,))


def albedo_map(network: ImageNetwork, image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Albedo [H, W, 3] uint8 sRGB of ``network``, zero outside the mask; see ``ImageNetwork.of_person``.

    Raises:
        InputError: the output is not in 0 … 1.
    """
    output = network.of_person(image, mask)
    person = output[mask > 0]
    low, high = _RANGE
    if person.size and ((person < low) | (person > high)).mean() > _MAX_OUTSIDE:
        got = f"{person.min():.3g} to {person.max():.3g}"
        raise InputError("network's albedo", expected="sRGB in 0 … 1", got=got, file=network.path)
    return np.where(mask[..., None] > 0, to_bytes(np.clip(output, 0, 1)), 0).astype(np.uint8)
