"""Normal maps from files or from a network, in whatever axes, brought to the camera's OpenCV axes.

Predictors agree on camera space and on little else: Sapiens' maps point right, up and to the viewer, others right,
down and away, and PNGs store either. The posed template knows what each pixel's normal should roughly be, so the
signs are those that agree with it best, and maps that agree with nothing are refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_image
from rnd_trainer.checking.normals import axes_in_words, best_reading

from .networks import ImageNetwork

Normals = NDArray[np.float32]

_SIGNS = np.array([(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float64)
_LEAST_AGREEMENT = 0.5  # mean cosine; a good predictor on a clothed person reaches 0.85, noise 0
_CLEAR_LEAD = 0.1  # of the best signs over the second best
_ENOUGH_PIXELS = 100


@dataclass(frozen=True)
class NormalAxes:
    """Which way a source's axes point, told by the template.

    Attributes:
        signs: of x, y and z on the way to OpenCV's axes.
        agreement: mean cosine with the template's normals after the flip.
        lead: by how much the second best signs agree less.
    """

    signs: tuple[int, int, int]
    agreement: float
    lead: float

    @property
    def name(self) -> str:
        """The source's axes in words."""
        words = (("left", "right"), ("up", "down"), ("towards the viewer", "away from the viewer"))
        return ", ".join(pair[sign > 0] for pair, sign in zip(words, self.signs))


def find_axes(maps: Iterable[Normals], template: Iterable[NDArray[np.float64]]) -> NormalAxes:
    """The signs by which ``maps`` agree best with ``template``, over all frames given.

    Args:
        maps: [H, W, 3] as the source has them; zero where it says nothing.
        template: [H, W, 3] unit normals of the posed template in OpenCV axes; zero outside.

    Raises:
        InputError: when no signs make them agree, or two do equally well.
    """
    products, pixels = np.zeros((3, 3)), 0
    for one, wanted in zip(maps, template):
        known = wanted.any(-1) & one.any(-1)
        products += wanted[known].T.astype(np.float64) @ one[known].astype(np.float64)
        pixels += int(known.sum())
    if pixels < _ENOUGH_PIXELS:
        raise InputError("normals", expected="some on the template", got=f"{pixels} pixels that both cover")
    products /= pixels
    scores = _SIGNS @ np.diag(products)
    order = np.argsort(-scores)
    best, lead = scores[order[0]], scores[order[0]] - scores[order[1]]
    x, y, z = (int(sign) for sign in _SIGNS[order[0]])
    axes = NormalAxes((x, y, z), float(best), float(lead))
    if best < _LEAST_AGREEMENT or lead < _CLEAR_LEAD:
        reading, cosine = best_reading(products)
        swapped = cosine > max(best + _CLEAR_LEAD, _LEAST_AGREEMENT)
        hint = f"with --normal-axes={axes_in_words(reading)} it would be {cosine:.2f}"
        raise InputError(
            "normals",
            expected=f"a mean cosine above {_LEAST_AGREEMENT:g} with the template's in one choice of axes",
            got=f"{best:.2f} at best ({axes.name}), {best - lead:.2f} at second best",
            hint=hint if swapped else "do they belong to these frames and poses?",
        )
    return axes


def to_opencv(normals: Normals, axes: NormalAxes) -> Normals:
    """``normals`` [H, W, 3] in OpenCV's axes; what then looks away from the viewer is turned edge-on."""
    turned = normals * np.array(axes.signs, np.float32)
    turned[..., 2] = np.minimum(turned[..., 2], 0)
    return _unit(turned)


def read_normals(path: str | Path) -> Normals:
    """A normal map [H, W, 3] in its own axes, unit or zero, from .npy (n, H×W×3 or 3×H×W) or a picture of (n + 1)/2."""
    path = existing_file(path, what="normals")
    if path.suffix.lower() == ".npy":
        try:
            normals = np.load(path, allow_pickle=False).astype(np.float32)
        except (ValueError, OSError, EOFError) as error:
            raise InputError("normals cannot be read", expected="an array of numbers", file=path) from error
        if normals.ndim == 3 and normals.shape[0] == 3 and normals.shape[2] != 3:
            normals = normals.transpose(1, 2, 0)
    else:
        pixels = read_image(path)
        if pixels.dtype.kind != "u":
            normals = pixels[..., :3].astype(np.float32)
        else:
            encoded = pixels[..., :3].astype(np.float32) / np.iinfo(pixels.dtype.name).max
            normals = (2 * encoded - 1) * encoded.any(-1, keepdims=True)  # black is "no data"
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise InputError("shape of normals", expected="H×W×3", got="×".join(map(str, normals.shape)), file=path)
    return _unit(np.nan_to_num(normals))  # Sapiens leaves NaN outside the person


def normal_network(path: Path) -> ImageNetwork:
    """The ONNX file ``path`` as a network that gives three channels (layouts: ``networks.ImageNetwork``)."""
    return ImageNetwork(path, outputs=(3,))


def normal_map(network: ImageNetwork, picture: NDArray[np.uint8], mask: NDArray[np.uint8]) -> Normals:
    """The map [H, W, 3] that ``network`` gives, in its own axes, zero outside the mask.

    The network sees the person's surroundings on grey, the way such predictors are trained.

    Args:
        picture: [H, W, 3] uint8 sRGB.
        mask: [H, W] uint8 coverage.
    """
    normals = np.zeros(picture.shape, np.float32)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return normals
    margin = (rows[-1] - rows[0]) // 10 + 2
    box = tuple(slice(max(int(side[0]) - margin, 0), int(side[-1]) + 1 + margin) for side in (rows, columns))
    alpha = mask[box][..., None] / np.float32(255)
    seen = np.round(picture[box] * alpha + 128 * (1 - alpha)).astype(np.uint8)
    output = network(seen)
    if output.min() >= 0:  # a network that gives pictures of normals
        output = 2 * output - 1
    normals[box] = _unit(output) * (mask[box] > 0)[..., None]
    return normals


def smoothed(normals: Normals, mask: NDArray[np.uint8]) -> Normals:
    """``normals`` with the pixels that the mask covers and the source leaves out filled from their neighbours."""
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
