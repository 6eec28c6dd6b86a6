"""The outline of a person's mask against the rim of the posed body, in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.core.threads import ahead

from .kinematics import Posed
from .normal_equations import NormalEquations
from .state import Layout, State
from .surface import Seen, Surface
from .terms import Lens, project, robust

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Image = NDArray[np.uint8]

SAMPLES = 120
"""points of an outline"""
BORDER = 3
"""px: an outline so near the image's edge is not the person's"""
GRID = 160
"""px of the longer side of the distance map"""
RIM = 0.35
"""cosine to the line of sight below which a vertex is on the rim"""
INSET_M = 0.004
"""m from such vertices outwards to the outline, on average"""
NORMAL_M = 0.09
"""m that two opposite normals count as in the search for the nearest rim vertex, times ½"""


@dataclass(frozen=True, eq=False)
class Outlines:
    """The outlines of T masks.

    Attributes:
        points: [T, SAMPLES, 2] px; normals: [T, SAMPLES, 2], outwards; seen: [T, SAMPLES], 0 where there is none.
        distance: [T, h, w] px from the mask and from what may hide the person, on a grid of ``scale`` cells a pixel.
    """

    points: Floats
    normals: Floats
    seen: Floats
    distance: NDArray[np.float32]
    scale: float


def outlines_of(masks, frames: int, size: tuple[int, int], hidden=None, seed: int = 0) -> Outlines:
    """Outlines of ``masks`` (T × [H, W] uint8 soft) of images of ``size`` (width, height).

    Where somebody may hide the person (``hidden``, like ``masks``), a mask's border is no outline.
    """
    width, height = size
    scale = min(1.0, GRID / max(width, height))
    grid = max(1, round(width * scale)), max(1, round(height * scale))
    points, normals = np.zeros((frames, SAMPLES, 2)), np.zeros((frames, SAMPLES, 2))
    seen, distance = np.zeros((frames, SAMPLES)), np.zeros((frames, grid[1], grid[0]), np.float32)
    rng = np.random.default_rng(seed)
    every = ahead(lambda k: _outline(masks[k], None if hidden is None else hidden[k], grid), range(frames))
    for k, (away, line, slope) in enumerate(every):
        distance[k] = away
        inner = (line >= BORDER).all(1) & (line[:, 0] < width - BORDER) & (line[:, 1] < height - BORDER)
        line, slope = line[inner], slope[inner]
        if len(line) < SAMPLES // 4:
            continue
        chosen = rng.choice(len(line), SAMPLES, replace=len(line) < SAMPLES)
        outward = -slope[chosen].astype(np.float64)
        length = np.linalg.norm(outward, axis=1, keepdims=True)
        points[k], normals[k] = line[chosen] + 0.5, outward / np.maximum(length, 1e-9)
        seen[k] = length[:, 0] > 1e-6
    return Outlines(points, normals, seen, distance, scale)


def _outline(
    mask: Image, hidden: Image | None, grid: tuple[int, int]
) -> tuple[NDArray[np.float32], Ints, NDArray[np.float32]]:
    """Distances from a mask on ``grid`` (width, height), its outlines' pixels [N, 2] and its slope there [N, 2]."""
    person = mask if hidden is None else np.maximum(mask, hidden)
    blur = max(1.5, 0.004 * max(mask.shape))
    x, y, wide, high = cv2.boundingRect(person)
    margin = BORDER + int(5 * blur)
    left, top = max(x - margin, 0), max(y - margin, 0)
    window = slice(top, y + high + margin), slice(left, x + wide + margin)
    allowed = np.zeros_like(mask)
    allowed[window] = _largest(person[window] > 127)
    binary = allowed[window] & (mask[window] > 127)
    away = cv2.resize(cv2.distanceTransform(1 - allowed, cv2.DIST_L2, 5), grid, interpolation=cv2.INTER_AREA)
    found, _ = cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    line = np.concatenate([np.zeros((0, 2), np.int64), *(line[:, 0] for line in found if len(line) > 30)])
    if hidden is not None:
        near = cv2.dilate(hidden[window], np.ones((2 * BORDER + 1,) * 2, np.uint8))
        line = line[near[line[:, 1], line[:, 0]] <= 127]
    smooth = cv2.GaussianBlur(binary.astype(np.float32), (0, 0), blur)
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], -1)
    return away, line + np.array([left, top]), slope[line[:, 1], line[:, 0]]


def _largest(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count <= 2:
        return mask.astype(np.uint8)
    return (labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)


def rim_matches(surface: Surface, state: State, posed: Posed, lens: Lens, outlines: Outlines) -> Ints:
    """The rim vertex [T, SAMPLES] nearest to each outline point, its normal counted; −1 where there is none."""
    frames = len(posed)
    result = np.full((frames, SAMPLES), -1, np.int64)
    scale = state.focal / np.maximum(-posed.joints[:, 0, 2], 0.05)
    for k in range(frames):
        if not outlines.seen[k].any():
            continue
        points, normals = surface.of_frame(state, posed, k)
        view = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
        rim = np.flatnonzero(np.abs((normals * view).sum(1)) < RIM)
        if len(rim) < 10:
            continue
        pixels, _ = project(points[rim], state, lens)
        flat = normals[rim, :2] * [1, -1]
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
        weight = NORMAL_M * scale[k]
        tree = cKDTree(np.concatenate([pixels, weight * flat], 1))
        query = np.concatenate([outlines.points[k], weight * outlines.normals[k]], 1)
        result[k] = surface.dense[rim[tree.query(query)[1]]]
    result[outlines.seen == 0] = -1
    return result


@dataclass(frozen=True, eq=False)
class OutlineTerm:
    """Outline points lie just outside of the rim's vertices, across it; points of the body lie inside the mask.

    Attributes:
        matches: [T, SAMPLES] vertices, −1 for none.
        deviation, inset: [T] px; vertices are so far inside.
    """

    surface: Surface
    outlines: Outlines
    matches: Ints
    deviation: Floats
    inset: Floats
    weight: float = 0.2
    inner_weight: float = 0.2
    limit: float = 4.0

    def __call__(
        self, state: State, posed: Posed, layout: Layout, lens: Lens, equations: NormalEquations | None
    ) -> float:
        found = self.matches >= 0
        vertices = np.maximum(self.matches, 0)
        cost = self._across(state, posed, layout, lens, vertices, found, equations)
        return cost + self._inside(state, posed, layout, lens, equations)

    def _across(
        self,
        state: State,
        posed: Posed,
        layout: Layout,
        lens: Lens,
        vertices: Ints,
        found: NDArray[np.bool_],
        equations: NormalEquations | None,
    ) -> float:
        seen = self.surface.seen(state, posed, lens, vertices)
        gap = seen.pixels - self.outlines.points
        inverse = 1 / self.deviation[:, None]
        residual = ((gap * self.outlines.normals).sum(-1) + self.inset[:, None]) * inverse
        far = 1 / (1 + (gap**2).sum(-1) * inverse**2 / (3 * self.limit) ** 2)  # a match that far is a guess
        squares = residual**2
        kept = 1 / (1 + squares / self.limit**2)
        weight = self.weight * far * found
        cost = float((weight * squares * kept).sum())
        if equations is not None:
            across = self.outlines.normals * inverse[..., None]
            equations.add(residual, weight * kept**2, *self._across_image(seen, posed, layout, lens, across))
        return cost

    def _inside(
        self, state: State, posed: Posed, layout: Layout, lens: Lens, equations: NormalEquations | None
    ) -> float:
        vertices = np.broadcast_to(self.surface.inner, (len(posed), len(self.surface.inner)))
        seen = self.surface.seen(state, posed, lens, vertices)
        value, slope = self._sample(seen.pixels)
        inverse = 1 / self.deviation[:, None]
        residual = value * inverse
        cost, kept = robust(residual**2, 2 * self.limit)
        if equations is not None:
            weight = self.inner_weight * kept * (value > 0)
            across = slope * inverse[..., None]
            equations.add(residual, weight, *self._across_image(seen, posed, layout, lens, across))
        return self.inner_weight * cost

    def _across_image(
        self, seen: Seen, posed: Posed, layout: Layout, lens: Lens, direction: Floats
    ) -> tuple[Floats, Floats]:
        """Derivatives [T, P, 3A + 3] and [T, P, G] of the pixels along ``direction`` [T, P, 2]."""
        along = direction[..., None, :]
        by_pose = along @ self.surface.by_pose(seen, posed, layout)
        return by_pose[..., 0, :], (along @ self.surface.by_shared(seen, posed, layout, lens))[..., 0, :]

    def _sample(self, pixels: Floats) -> tuple[Floats, Floats]:
        """Distance [T, P] px from the mask and its slope [T, P, 2]; bilinear, level outside the image."""
        maps = self.outlines.distance
        frames, high, wide = maps.shape
        place = pixels * self.outlines.scale - 0.5
        limit = np.array([wide - 1.001, high - 1.001])
        inside = np.clip(place, 0, limit)
        corner = inside.astype(np.int64)
        s, t = np.moveaxis(inside - corner, -1, 0)
        x, y = np.moveaxis(corner, -1, 0)
        k = np.arange(frames)[:, None]
        a, b, c, d = maps[k, y, x], maps[k, y, x + 1], maps[k, y + 1, x], maps[k, y + 1, x + 1]
        value = (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d)
        slope = np.stack([(1 - t) * (b - a) + t * (d - c), (1 - s) * (c - a) + s * (d - b)], -1)
        return value, slope * self.outlines.scale * (place == inside)
