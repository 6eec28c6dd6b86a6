"""Figures of few pixels: rendered finer and averaged, so that they keep their width and their light.

The pixel filter (``raster.oracle.DILATION``) widens an opaque body by a fixed share of a pixel: 1.4 % of the coverage
of a person 192 pixels high, 64 % of one of 16 pixels. Blending saturates, so no factor on opacities undoes that;
smaller pixels do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.raster.oracle import NEAR

MIN_PIXELS_PER_METRE = 110.0
"""at which the filter is still small: 192 pixels for a person of 1.75 m"""
MAX_FACTOR = 64
"""fine pixels along a pixel's side; a person of 3 pixels needs them"""
MARGIN = 0.35
"""m around the joints that hair, hands and clothes stay within"""
_UPPER = np.array([*product([False, True], repeat=3)])  # sides of a box that meet in each of its corners


@dataclass(frozen=True)
class FineView:
    """A part of the image of ``full``, from column ``left`` and row ``top``: ``factor``² pixels for each of its own."""

    camera: Camera
    factor: int
    left: int
    top: int
    full: Camera

    def averaged(self, raster: Raster) -> Raster:
        """``raster`` of ``camera``, box-filtered and put into the full image."""
        full = []
        for small in self.means(raster):
            layer = np.zeros((self.full.height, self.full.width, *small.shape[2:]), np.float32)
            layer[self.region] = small
            full.append(layer)
        image, alpha, depth = full
        return replace(raster, image=image, alpha=alpha, depth=depth, srgb=None)

    @property
    def region(self) -> tuple[slice, slice]:
        """Rows and columns of the part in the full image."""
        height, width = self.camera.height // self.factor, self.camera.width // self.factor
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def means(self, raster: Raster) -> list[Floats32]:
        """Image, alpha and depth of the part, box-filtered."""
        return [self._means(layer) for layer in (raster.image, raster.alpha, raster.depth)]

    def _means(self, layer: Floats32) -> Floats32:
        height, width, s = self.camera.height // self.factor, self.camera.width // self.factor, self.factor
        rows = np.add.reduce(layer.reshape(height, s, width * s, *layer.shape[2:]), axis=1)
        means: Floats32 = rows[:, ::s].copy()
        for k in range(1, s):  # ten times as fast as numpy's mean over two axes
            means += rows[:, k::s]
        means *= np.float32(1 / s**2)
        return means


class Extent(NamedTuple):
    """What a body takes up in a view: depths in m, the ``factor`` of its ``FineView``, and pixels.

    It may cover columns ``left`` to ``right`` and rows ``top`` to ``bottom``, the last excluded; all of them where it
    is not completely in front of the eye.
    """

    nearest: float
    farthest: float
    factor: int
    left: int
    top: int
    right: int
    bottom: int

    def overlaps(self, other: Extent) -> bool:
        """Whether they may share pixels."""
        columns = max(self.left, other.left) < min(self.right, other.right)
        return columns and max(self.top, other.top) < min(self.bottom, other.bottom)

    def union(self, other: Extent) -> Extent:
        """Of both, on the finer grid."""
        nearest, farthest = min(self.nearest, other.nearest), max(self.farthest, other.farthest)
        left, top = min(self.left, other.left), min(self.top, other.top)
        right, bottom = max(self.right, other.right), max(self.bottom, other.bottom)
        return Extent(nearest, farthest, max(self.factor, other.factor), left, top, right, bottom)

    def view(self, camera: Camera) -> FineView:
        """Its part of the view of ``camera``."""
        part = camera.cropped(slice(self.top, self.bottom), slice(self.left, self.right))
        fine = part.resized(part.width * self.factor, part.height * self.factor)
        return FineView(fine, self.factor, self.left, self.top, camera)


def extent(camera: Camera, points: NDArray[np.floating[Any]], least: float) -> Extent:
    """The ``Extent`` of a body around ``points`` [N, 3] m in the frame of ``camera``'s ``world_to_camera``.

    Its factor gives ``least`` pixels per metre or more; 1 where the body is not completely in front of the eye, or
    beside the image.
    """
    depths = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    nearest, farthest = float(depths.min(initial=np.inf)) - MARGIN, float(depths.max(initial=-np.inf)) + MARGIN
    everywhere = Extent(nearest, farthest, 1, 0, 0, camera.width, camera.height)
    if not NEAR <= nearest < np.inf:  # NaN too
        return everywhere
    pixels, corner_depths = camera.project(np.where(_UPPER, points.max(axis=0) + MARGIN, points.min(axis=0) - MARGIN))
    if not corner_depths.min() >= NEAR:
        return everywhere
    left, top, right, bottom = camera.box(pixels)
    factor = min(math.ceil(least * nearest / min(camera.K[0, 0], camera.K[1, 1])), MAX_FACTOR)
    in_image = left < right and top < bottom
    return Extent(nearest, farthest, max(factor, 1) if in_image else 1, left, top, right, bottom)


def fine_view(camera: Camera, points: NDArray[np.floating[Any]]) -> FineView | None:
    """The view to render instead of ``camera``; None where a body around ``points`` [N, 3] m is large enough or unseen.

    ``points`` are in the frame of ``camera``'s ``world_to_camera``.
    """
    seen = extent(camera, points, MIN_PIXELS_PER_METRE)
    return None if seen.factor == 1 else seen.view(camera)


class Group(NamedTuple):
    """Bodies, by number, that are splatted together into a part of the image."""

    bodies: list[int]
    extent: Extent


def depth_groups(extents: Sequence[Extent]) -> list[Group]:
    """Groups in front-to-back order: composited so, they are as one sort of all Gaussians by depth.

    The first group is that of bodies on the image's own grid, if any. A body that is not completely in front of one on
    a finer grid, and may cover the same pixels, is rendered on the finer grid too.
    """
    factors = [seen.factor for seen in extents]
    pairs = [(i, j) for i, j in permutations(range(len(extents)), 2) if extents[i].overlaps(extents[j])]
    changed = True
    while changed:
        changed = False
        for i, j in pairs:
            if factors[i] < factors[j] and extents[i].farthest > extents[j].nearest:
                factors[i], changed = factors[j], True
    groups: list[Group] = []
    for factor in sorted({*factors}):
        parts: list[Group] = []
        for i, seen in enumerate(extents):
            if factors[i] != factor:
                continue
            part = Group([i], seen._replace(factor=factor))
            touching = parts if factor == 1 else [other for other in parts if other.extent.overlaps(part.extent)]
            while touching:
                parts = [other for other in parts if other not in touching]
                for other in touching:
                    part = Group([*other.bodies, *part.bodies], other.extent.union(part.extent))
                touching = [other for other in parts if other.extent.overlaps(part.extent)]
            parts.append(part)
        groups += [Group(sorted(part.bodies), part.extent) for part in parts]
    return groups
