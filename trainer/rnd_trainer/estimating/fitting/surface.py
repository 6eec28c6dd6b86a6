"""The figure's surface as images show it: fewer vertices, few bones each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .figure import Figure, vertex_normals
from .kinematics import Posed, shape_derivative, skinned_derivative
from .state import Layout, State
from .terms import Lens, project

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BONES = 3
"""bones of a vertex that are followed"""
INNER = 120
"""vertices far from each other, tested against the mask"""
POINTS = 150
"""points compared with the image in a frame, at most"""
FACING = 0.3
"""cosine to the line of sight above which a vertex faces the camera"""
_CELL_M = 0.03  # of the grid in which nearer vertices hide others, at the person's distance
_SPACING_M = 0.05  # one point in each cell of that size at the person's distance
_THICKNESS_M = 0.10  # vertices so far behind the nearest are hidden


@dataclass(frozen=True, eq=False)
class Seen:
    """Points [T, P] of the surface in the image.

    Attributes:
        pixels: [T, P, 2]; by_point: [T, P, 2, 3] their derivative by the points.
        parts: [T, P, BONES, 3] m, the points as each of their bones moves them.
    """

    vertices: Ints
    pixels: Floats
    by_point: Floats
    parts: Floats


class Surface:
    """``figure``'s surface.

    Attributes:
        dense: the vertices used; inner: ``INNER`` of all vertices, far from each other.
    """

    def __init__(self, figure: Figure, count: int = 2500) -> None:
        self.figure = figure
        body = figure.body
        rng = np.random.default_rng(1)
        self.dense = np.sort(rng.choice(len(body.vertices), min(count, len(body.vertices)), replace=False))
        self.normals = vertex_normals(body.vertices, body.faces)
        self.bones = np.argsort(-body.skinning_weights, axis=1)[:, :BONES].astype(np.int64)
        weights = np.take_along_axis(body.skinning_weights.astype(np.float64), self.bones, 1)
        self.weights = weights / weights.sum(1, keepdims=True)
        self.blend = np.zeros(body.skinning_weights.shape)
        np.put_along_axis(self.blend, self.bones, self.weights, 1)
        self.inner = _spread(body.vertices, INNER)
        self._kept = np.zeros(len(figure.names)), body.vertices

    def whole(self, state: State, posed: Posed, frame: int) -> Floats:
        """Positions [V, 3] of all vertices in one frame, in the fit's world."""
        return _moved(self._blended(posed, frame), self._rest(state.shape))

    def of_frame(self, state: State, posed: Posed, frame: int) -> tuple[Floats, Floats]:
        """Positions and normals [D, 3] of the dense vertices in one frame, in the fit's world."""
        blended = self._blended(posed, frame, self.dense)
        points = _moved(blended, self._rest(state.shape)[self.dense])
        return points, np.einsum("pij,pj->pi", blended[..., :3], self.normals[self.dense])

    def visible(self, state: State, posed: Posed, lens: Lens, frame: int) -> tuple[Ints, Floats]:
        """Vertices that the camera sees in one frame, and their pixels [P, 2]."""
        points, normals = self.of_frame(state, posed, frame)
        facing = -(normals * points).sum(1) / np.maximum(np.linalg.norm(points, axis=1), 1e-9) > FACING
        pixels, _ = project(points, state, lens)
        depth = -points[:, 2]
        cells = np.floor(pixels / (_CELL_M * state.focal / np.maximum(np.median(depth), 0.1))).astype(np.int64)
        cells -= cells.min(0) - 1
        nearest = np.full(cells.max(0) + 2, np.inf)
        x, y = cells.T
        np.minimum.at(nearest, (x, y), depth)
        around = [nearest[x + i, y + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        seen = facing & (depth < np.min(around, axis=0) + _THICKNESS_M)
        return self.dense[seen], pixels[seen]

    def seen(self, state: State, posed: Posed, lens: Lens, vertices: Ints) -> Seen:
        """``vertices`` [T, P] in the image."""
        parts = self._parts(posed, state.shape, vertices)
        points = np.einsum("tpb,tpbi->tpi", self.weights[vertices], parts)
        return Seen(vertices, *project(points, state, lens), parts)

    def by_pose(self, seen: Seen, posed: Posed, layout: Layout) -> Floats:
        """d pixels / d unknowns of the frame [T, P, 2, 3A + 3]."""
        weights, bones = self.weights[seen.vertices], self.bones[seen.vertices]
        return np.asarray(seen.by_point @ skinned_derivative(posed, seen.parts, weights, bones, layout.active))

    def by_shared(self, seen: Seen, posed: Posed, layout: Layout, lens: Lens) -> Floats:
        """d pixels / d shared unknowns [T, P, 2, G]: shape and focal length."""
        figure, vertices = self.figure, seen.vertices
        shared = np.zeros((*seen.pixels.shape, layout.shared))
        if figure.names:
            bones = self.bones[vertices]
            frames = np.arange(len(posed))[:, None, None]
            joints = shape_derivative(posed, figure.joint_basis)[frames, bones]  # [T, P, B, 3, K]
            lever = figure.vertex_basis[:, vertices][:, :, :, None] - figure.joint_basis[:, bones]
            by_shape = joints + posed.world[frames, bones] @ np.moveaxis(lever, 0, -1)
            shared[..., layout.shape] = seen.by_point @ np.einsum("tpb,tpbik->tpik", self.weights[vertices], by_shape)
        shared[..., layout.focal] = seen.pixels - lens.centre
        return shared

    def _rest(self, shape: Floats) -> Floats:
        """All vertices [V, 3] at rest; the last shape's are kept for the other frames and terms of a step."""
        kept, vertices = self._kept
        if not np.array_equal(shape, kept):
            vertices = self.figure.shaped(shape).vertices
            self._kept = shape, vertices
        return vertices

    def _blended(self, posed: Posed, frame: int, vertices: Ints | slice = slice(None)) -> Floats:
        """Transforms [P, 3, 4] of ``vertices`` [P] in one frame, by linear blend skinning."""
        turn = posed.world[frame]
        shift = posed.joints[frame] - (turn @ posed.rest[..., None])[..., 0]
        transforms = np.concatenate([turn, shift[..., None]], -1).reshape(len(turn), 12)
        return (self.blend[vertices] @ transforms).reshape(-1, 3, 4)

    def _parts(self, posed: Posed, shape: Floats, vertices: Ints) -> Floats:
        """Positions [T, P, BONES, 3] of ``vertices`` [T, P] as each of their bones moves them."""
        bones = self.bones[vertices]
        frames = np.arange(len(posed))[:, None, None]
        lever = self._rest(shape)[vertices][:, :, None] - posed.rest[bones]
        return np.asarray(
            posed.joints[frames, bones] + np.einsum("tpbij,tpbj->tpbi", posed.world[frames, bones], lever)
        )


def _moved(transforms: Floats, points: Floats) -> Floats:
    """``points`` [P, 3] by one of ``transforms`` [P, 3, 4] each."""
    return np.asarray(np.einsum("pij,pj->pi", transforms[..., :3], points) + transforms[..., 3])


def spaced(pixels: Floats, usable: Ints, metre: float, rng: np.random.Generator) -> Ints:
    """Up to ``POINTS`` of the indices ``usable`` of ``pixels`` [P, 2], ``metre`` px a metre; one in each small cell."""
    known = rng.permutation(usable)
    _, first = np.unique(np.floor(pixels[known] / (_SPACING_M * metre)), axis=0, return_index=True)
    return rng.permutation(known[first])[:POINTS]


def _spread(points: Floats, count: int) -> Ints:
    """Indices of ``count`` points far from each other."""
    nearest, chosen = np.full(len(points), np.inf), [0]
    for _ in range(count - 1):
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen)
