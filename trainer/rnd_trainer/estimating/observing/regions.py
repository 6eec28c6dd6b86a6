"""Square regions of an image, rotated with the person, and the crops that networks read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

BODY_SCALE = 1.25
"""side of a body's region in diameters of the circle through its two points, as BlazePose was trained"""
_SAME_PERSON = 0.15  # distance of two regions' centres, in sides of the larger, from which they are of two people


@dataclass(frozen=True)
class Region:
    """A square: its centre in pixels, its side in pixels, its rotation in radians (clockwise in the image)."""

    x: float
    y: float
    size: float
    rotation: float = 0.0

    @classmethod
    def of_body(cls, centre: Floats, top: Floats) -> Region:
        """The region around ``centre`` (the middle of the hips) whose circle goes through ``top`` [2]."""
        across = np.asarray(top, np.float64) - centre
        size = 2 * BODY_SCALE * float(np.hypot(*across))
        return cls(float(centre[0]), float(centre[1]), size, float(np.arctan2(across[0], -across[1])))

    def scaled(self, factor: float) -> Region:
        return replace(self, size=self.size * factor)

    def to_image(self, side: int) -> Floats:
        """The matrix [2, 3] from positions in a crop of ``side`` pixels to positions in the image."""
        cosine, sine, step = np.cos(self.rotation), np.sin(self.rotation), self.size / side
        linear = step * np.array([[cosine, -sine], [sine, cosine]])
        middle = np.array([self.x, self.y]) - linear @ np.full(2, side / 2)
        return np.hstack([linear, middle[:, None]])

    def overlap(self, other: Region) -> float:
        """Intersection over union of the two circles' bounding squares, 0…1."""
        half, its_half = self.size / 2, other.size / 2
        shared = 1.0
        for a, b in ((self.x, other.x), (self.y, other.y)):
            shared *= max(0.0, min(a + half, b + its_half) - max(a - half, b - its_half))
        return shared / (self.size**2 + other.size**2 - shared)

    def same_person(self, other: Region) -> bool:
        """Whether the hips of both are about at one place; people side by side have regions that overlap."""
        apart = float(np.hypot(self.x - other.x, self.y - other.y))
        return apart < _SAME_PERSON * max(self.size, other.size)


class Shrunk:
    """An image reduced by a whole factor so that crops of regions of about one size are sampled without aliasing."""

    def __init__(self, image: Image, size: float, side: int) -> None:
        self.factor = max(1, int(size / side))
        height, width = image.shape[0] // self.factor, image.shape[1] // self.factor
        if self.factor > 1:
            whole = image[: height * self.factor, : width * self.factor]
            image = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        self.image = image

    def crop(self, region: Region, side: int) -> NDArray[np.float32]:
        """RGB [side, side, 3] in 0…1; black outside of the image."""
        return np.asarray(crop(self.image, region.to_image(side) / self.factor, side) / 255, np.float32)


def crop(image: NDArray[Any], to_image: Floats, side: int) -> NDArray[Any]:
    """The [side, side, …] pixels of ``image`` at the positions that ``to_image`` [2, 3] gives."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, _by_index(to_image), (side, side), flags=flags)


def uncrop(pixels: NDArray[np.float32], to_image: Floats, size: tuple[int, int]) -> NDArray[np.float32]:
    """``pixels`` of a crop, put where ``to_image`` has them in an image of ``size``; zero elsewhere."""
    return cv2.warpAffine(pixels, _by_index(to_image), size, flags=cv2.INTER_LINEAR)


def moved(points: Floats, matrix: Floats) -> Floats:
    """``points`` [..., 2] by the matrix [2, 3]."""
    result: Floats = points @ matrix[:, :2].T + matrix[:, 2]
    return result


def _by_index(matrix: Floats) -> Floats:
    """The matrix between positions as one between pixel indices, whose centres are at whole numbers."""
    shifted = matrix.copy()
    shifted[:, 2] += matrix[:, :2] @ np.full(2, 0.5) - 0.5
    return shifted
