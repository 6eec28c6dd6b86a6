"""Axes of normal maps, compared with the template's own normals."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .silhouette import RenderedMesh

Floats = NDArray[np.float64]

GAIN = 0.15
"""mean cosine that other axes must gain; estimated normals err by about 10° (0.015)"""
_AXES = "xyz"


class AxesAgreement(NamedTuple):
    """Agreement of normal maps with the template."""

    cosine: float  # mean cosine to the template's normals, as they are
    facing: float  # share of normals that face the camera (z < 0)
    best_cosine: float  # of the best signed permutation
    best_axes: str  # that permutation, such as "x,-y,-z"

    @property
    def wrong(self) -> bool:
        return self.best_cosine > self.cosine + GAIN


def parse_axes(text: str) -> Floats:
    """Signed permutation [3, 3] of a text such as "x,-y,-z"; raises ``ValueError`` otherwise."""
    matrix = np.zeros((3, 3))
    for row, part in enumerate(text.replace(" ", "").split(",")):
        sign, axis = part[:-1], part[-1:]
        if row > 2 or sign not in ("", "-", "+") or axis not in tuple(_AXES):
            raise ValueError(text)
        matrix[row, _AXES.index(axis)] = -1 if sign == "-" else 1
    if not np.allclose(matrix @ matrix.T, np.eye(3)):
        raise ValueError(text)
    return matrix


def format_axes(matrix: Floats) -> str:
    """The inverse of ``parse_axes``."""
    columns = np.abs(matrix).argmax(1)
    return ",".join(("" if row[column] > 0 else "-") + _AXES[column] for row, column in zip(matrix, columns))


def compare_axes(pairs: list[tuple[Floats, Floats]], applied: Floats | None = None) -> AxesAgreement:
    """Agreement of (map's normals [n, 3], template's normals [n, 3]) at the same pixels, in OpenCV camera axes.

    ``applied`` [3, 3] is the import's permutation of the maps; ``best_axes`` refers to the source's maps.
    """
    maps = np.concatenate([a for a, _ in pairs])
    template = np.concatenate([b for _, b in pairs])
    products = template.T @ maps / len(maps)
    best, cosine = best_permutation(products)
    axes = format_axes(best @ (np.eye(3) if applied is None else applied))
    return AxesAgreement(float(np.trace(products)), float((maps[:, 2] < 0).mean()), cosine, axes)


def best_permutation(products: Floats) -> tuple[Floats, float]:
    """Signed permutation [3, 3] of a map's axes that agrees best with the template, and its mean cosine.

    ``products`` [3, 3] is the mean of template_i · map_j over the pixels; of equals the least changed wins.
    """
    candidates = [
        np.array(signs)[:, None] * np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    best = max(candidates, key=lambda candidate: round(float((candidate * products).sum()), 9))
    return best, float((best * products).sum())


def paired_normals(normals: NDArray[np.float32], template: RenderedMesh) -> tuple[Floats, Floats]:
    """Pairs of normals [n, 3] where the map ``normals`` [H, W, 3] and ``template`` [h, w] both have one."""
    height, width = template.mask.shape
    rows = ((np.arange(height) + 0.5) * normals.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * normals.shape[1] / width).astype(int)
    small = normals[rows][:, columns].astype(np.float64)
    both = template.mask & (np.abs(small).max(-1) > 0)
    return small[both], template.normals[both]
