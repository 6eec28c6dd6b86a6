"""Normal maps from files or a network, in OpenCV camera axes.

Predictors differ in the signs of their axes; the signs that agree best with the posed template are chosen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_image
from rnd_trainer.checking.normals import best_permutation, format_axes
from rnd_trainer.importing.images import load_array

from .networks import ImageNetwork

Normals = NDArray[np.float32]

_SIGNS = np.array([(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float64)
_MIN_COSINE = 0.5  # mean cosine; a good predictor on a clothed person reaches 0.85, noise 0
_MIN_LEAD = 0.1  # of the best signs over the second best
_MIN_PIXELS = 100


@dataclass(frozen=True)
class NormalAxes:
    """Directions of a source's axes, found by the template."""

    signs: tuple[int, int, int]  # factors of x, y and z to OpenCV's axes
    agreement: float  # mean cosine with the template's normals, signs applied

    @property
    def name(self) -> str:
        """The source's axes in words."""
        words = (("left", "right"), ("up", "down"), ("towards the viewer", "away from the viewer"))
        return ", ".join(pair[sign > 0] for pair, sign in zip(words, self.signs))


def find_axes(maps: Iterable[Normals], template: Iterable[NDArray[np.float64]]) -> NormalAxes:
    """Signs by which ``maps`` agree best with ``template``.

    Args:
        maps: [H, W, 3] in the source's axes; zero where unknown.
        template: [H, W, 3] unit normals of the posed template in OpenCV axes; zero outside.

    Raises:
        InputError: no signs agree, or two agree equally well.
    """
    products, pixels = np.zeros((3, 3)), 0
    for one, wanted in zip(maps, template):
        known = wanted.any(-1) & one.any(-1)
        products += wanted[known].T.astype(np.float64) @ one[known].astype(np.float64)
        pixels += int(known.sum())
    if pixels < _MIN_PIXELS:
        raise InputError("normals", expected="some on the template", got=f"{pixels} pixels that both cover")
    products /= pixels
    scores = _SIGNS @ np.diag(products)
    order = np.argsort(-scores)
    best, lead = scores[order[0]], scores[order[0]] - scores[order[1]]
    x, y, z = (int(sign) for sign in _SIGNS[order[0]])
    axes = NormalAxes((x, y, z), float(best))
    if best < _MIN_COSINE or lead < _MIN_LEAD:
        permutation, cosine = best_permutation(products)
        swapped = cosine > max(best + _MIN_LEAD, _MIN_COSINE)
        hint = f"with --normal-axes={format_axes(permutation)} it would be {cosine:.2f}"
        raise InputError(
            "normals",
            expected=f"a mean cosine above {_MIN_COSINE:g} with the template's in one choice of axes",
            got=f"{best:.2f} at best ({axes.name}), {best - lead:.2f} at second best",
            hint=hint if swapped else "do they belong to these frames and poses?",
        )
    return axes


def to_opencv(normals: Normals, axes: NormalAxes) -> Normals:
    """``normals`` [H, W, 3] in OpenCV's axes; back-facing ones are projected to z = 0."""
    flipped = normals * np.array(axes.signs, np.float32)
    flipped[..., 2] = np.minimum(flipped[..., 2], 0)
    return _unit(flipped)


def read_normals(path: str | Path) -> Normals:
    """Normal map [H, W, 3], unit or zero, from .npy (n, H×W×3 or 3×H×W) or an image of (n + 1)/2."""
    path = existing_file(path, what="normals")
    if path.suffix.lower() == ".npy":
        normals: NDArray[Any] = load_array(path, "normals").astype(np.float32)
        if normals.ndim == 3 and normals.shape[0] == 3 and normals.shape[2] != 3:
            normals = normals.transpose(1, 2, 0)
    else:
        pixels = read_image(path)
        if pixels.dtype.kind != "u":
            normals = pixels[..., :3].astype(np.float32)
        else:
            encoded = pixels[..., :3].astype(np.float32) / np.iinfo(pixels.dtype.name).max
            normals = (2 * encoded - 1) * encoded.any(-1, keepdims=True)  # black: no data
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise InputError("shape of normals", expected="H×W×3", got="×".join(map(str, normals.shape)), file=path)
    return _unit(np.nan_to_num(normals))  # Sapiens leaves NaN outside the person


def normal_network(path: Path) -> ImageNetwork:
    """Network of the ONNX file ``path`` with three output channels."""
    return ImageNetwork(path, outputs=(3,))


def normal_map(network: ImageNetwork, image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> Normals:
    """Map [H, W, 3] of ``network`` in its own axes, zero outside the mask; see ``ImageNetwork.of_person``."""
    output = network.of_person(image, mask)
    if output.min() >= 0:  # the network returns (n + 1)/2
        output = 2 * output - 1
    return np.where(mask[..., None] > 0, _unit(output), 0).astype(np.float32)


def fill_holes(normals: Normals, mask: NDArray[np.uint8]) -> Normals:
    """``normals`` with unknown pixels inside the mask filled from the nearest known ones."""
    known = normals.any(-1)
    holes = (mask > 0) & ~known
    if not holes.any() or not known.any():
        return normals
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(labels.max() + 1, np.int64)
    nearest[labels[known]] = np.flatnonzero(known)
    filled = normals.copy()
    filled[holes] = normals.reshape(-1, 3)[nearest[labels[holes]]]
    return filled


def _unit(normals: Normals) -> Normals:
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = length > 0.1
    return np.where(known, normals / np.where(known, length, 1), 0).astype(np.float32)
