"""The person looks in each frame as in others.

Flow tells how the surface moves from frame to frame; this tells where it is, by what it looked like elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.threads import ahead
from rnd_trainer.checking.silhouette import z_buffer
from rnd_trainer.estimating.flow import LUCAS_KANADE, SIDE, TEXTURE, ZOOM, texture, tracked
from rnd_trainer.estimating.observations import GreyImages

from .kinematics import Posed
from .normal_equations import NormalEquations
from .state import Layout, State
from .surface import FACING, POINTS, Ints, Surface, spaced
from .terms import Lens, project, robust

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Floats32 = NDArray[np.float32]

KEY_FRAMES = 64
"""frames that others are compared with, at most"""
OTHERS = 12
"""of these, for one frame"""
_SAME_M = 0.05  # depth within which a point is the one that another frame shows
_SHARED = 0.5  # least share of a frame's faces that another should show too
_EVEN_PX = 25  # side of the window in which brightness is made equal
_INSIDE_PX = 3  # from the rim of what is compared
_MAX_GAP = 1.5  # px between a point and where it ends, followed there and back
_DEVIATION_PX, _DEVIATION_M = 0.5, 0.008
_COARSE: dict[str, Any] = {"winSize": (21, 21), "maxLevel": 1}
_MAX_CHANGE = 3.0  # px, from the coarse window's answer to the fine one's


@dataclass(frozen=True, eq=False)
class AppearanceTerm:
    """Vertices lie where their frame shows them.

    Attributes:
        vertices: [T, POINTS]; pixels: [T, POINTS, 2]; inverse: [T, POINTS] one over the deviation, px⁻¹, 0 for none.
    """

    surface: Surface
    vertices: Ints
    pixels: Floats
    inverse: Floats
    weight: float = 1.0
    limit: float = 3.0

    def __call__(
        self, state: State, posed: Posed, layout: Layout, lens: Lens, equations: NormalEquations | None
    ) -> float:
        seen = self.surface.seen(state, posed, lens, self.vertices)
        residual = (seen.pixels - self.pixels) * self.inverse[..., None]
        cost, kept = robust((residual**2).sum(-1), self.limit)
        if equations is not None:
            inverse, count = self.inverse[..., None, None], len(residual)
            equations.add(
                residual.reshape(count, -1),
                self.weight * np.repeat(kept, 2, axis=1),
                (inverse * self.surface.by_pose(seen, posed, layout)).reshape(count, -1, layout.unknowns),
                (inverse * self.surface.by_shared(seen, posed, layout, lens)).reshape(count, -1, layout.shared),
            )
        return self.weight * cost


@dataclass(frozen=True, eq=False)
class View:
    """The body over one frame's image of the person.

    Attributes:
        grey: [h, w], 0 outside of the person; corner, scale: pixels of the frame are ``corner + pixels / scale``.
        points: [V, 3] the vertices' pixels in ``grey``, and their depths, m.
        facing: [F] cosines of the faces to the line of sight.
        nearest: [h, w] the face at each pixel, −1 for none; depth: [h, w] its depth, m.
    """

    grey: Image
    corner: Floats
    scale: float
    points: Floats
    facing: Floats
    nearest: NDArray[np.int64]
    depth: Floats32

    def to_image(self, pixels: Floats) -> Floats:
        """Pixels of ``grey`` from the frame's."""
        return (pixels - self.corner) * self.scale


def appearance_term(
    surface: Surface,
    state: State,
    posed: Posed,
    lens: Lens,
    images: GreyImages,
    weight: float,
    on_progress: Callable[[float], None] = lambda share: None,
) -> AppearanceTerm:
    """The term of a body posed roughly right, from ``images`` of the person, 0 elsewhere."""
    frames = len(posed)
    faces = surface.figure.body.faces.astype(np.int64)
    metre = state.focal / np.maximum(-posed.joints[:, 0, 2], 0.1)  # px
    keys = np.unique(np.linspace(0, frames - 1, min(frames, KEY_FRAMES)).round().astype(int))

    def view_of(frame: int) -> View:
        return _view(surface, state, posed, lens, images[frame], frame, faces)

    views = dict(zip(keys.tolist(), ahead(view_of, keys.tolist())))
    shown = np.stack([_shown(view, len(faces)) for view in views.values()])
    rng = np.random.default_rng(0)
    term = AppearanceTerm(
        surface, np.zeros((frames, POINTS), np.int64), np.zeros((frames, POINTS, 2)), np.zeros((frames, POINTS)), weight
    )

    def compared(frame: int) -> tuple[Ints, Floats, Floats, float]:
        """Visible vertices, their pixels, how far from these the image has them, and its scale."""
        view = views.get(frame) or view_of(frame)
        others = keys[_alike(_shown(view, len(faces)), shown, keys != frame)]
        vertices, pixels = surface.visible(state, posed, lens, frame)
        moved = _moved(view, [views[int(other)] for other in others], faces, view.to_image(pixels))
        return vertices, pixels, moved / view.scale, view.scale

    for k, (vertices, pixels, moved, scale) in enumerate(ahead(compared, range(frames))):
        chosen = spaced(pixels, np.flatnonzero(np.isfinite(moved).all(1)), metre[k], rng)
        here = slice(0, len(chosen))
        term.vertices[k, here], term.pixels[k, here] = vertices[chosen], pixels[chosen] + moved[chosen]
        term.inverse[k, here] = 1 / np.hypot(_DEVIATION_PX / scale, _DEVIATION_M * metre[k])
        on_progress((k + 1) / frames)
    return term


def _view(
    surface: Surface, state: State, posed: Posed, lens: Lens, image: Image, frame: int, faces: NDArray[np.int64]
) -> View:
    rows, columns = np.nonzero(image)
    if not len(rows):
        rows, columns = (np.array([0, side - 1]) for side in image.shape)
    top, left = rows.min(), columns.min()
    cut = image[top : rows.max() + 1, left : columns.max() + 1]
    scale = min(ZOOM, SIDE / max(cut.shape))
    width, height = (max(1, round(side * scale)) for side in cut.shape[::-1])
    within = cv2.resize(np.where(cut > 0, np.uint8(255), np.uint8(0)), (width, height), interpolation=cv2.INTER_AREA)
    grey = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    grey[within < 255] = 0
    world = surface.whole(state, posed, frame)
    pixels, _ = project(world, state, lens)
    corner = np.array([left, top], np.float64)
    points = np.concatenate([(pixels - corner) * scale, -world[:, 2:]], axis=1)
    a, b, c = (world[faces[:, k]] for k in range(3))
    normals, middles = np.cross(b - a, c - a), a + b + c
    length = np.linalg.norm(normals, axis=1) * np.linalg.norm(middles, axis=1)
    facing = -(normals * middles).sum(1) / np.maximum(length, 1e-12)
    nearest = z_buffer(points[:, :2], 1 / np.maximum(points[:, 2], 0.05), faces, width, height)
    return View(grey, corner, scale, points, facing, nearest, _depth(nearest, faces, points))


def _shown(view: View, faces: int) -> Floats32:
    """1 for each face that the frame shows."""
    result = np.zeros(faces, np.float32)
    result[view.nearest[view.nearest >= 0]] = 1
    return result


def _alike(one: Floats32, shown: Floats32, allowed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Indices of ``OTHERS`` of the frames ``shown`` [K, F] that show much of what ``one`` [F] shows, evenly spread."""
    share = np.where(allowed, shown @ one / max(float(one.sum()), 1.0), -1)
    least = min(_SHARED, float(np.sort(share)[-min(OTHERS, len(share))]))
    found = np.flatnonzero((share >= least) & (share > 0))
    return found[np.unique(np.linspace(0, len(found) - 1, min(len(found), OTHERS)).round().astype(int))]


def _elsewhere(view: View, others: list[View], faces: NDArray[np.int64]) -> tuple[Floats32, NDArray[np.bool_]]:
    """Grey levels [h, w] that ``others`` show of the faces at each pixel, and where two or more of them do."""
    total, weight = np.zeros(view.grey.shape), np.zeros(view.grey.shape)
    count = np.zeros(view.grey.shape, np.int64)
    for other in others:
        _add_other(
            view.nearest, faces, view.points, other.points, other.depth, other.grey, other.facing, total, weight, count
        )
    return (total / np.maximum(weight, 1e-9)).astype(np.float32), count >= 2


def _moved(view: View, others: list[View], faces: NDArray[np.int64], points: Floats) -> Floats:
    """How far ``points`` [P, 2] px of the posed body are from where the image has them [P, 2]; NaN where unknown."""
    wanted, known = _elsewhere(view, others, faces)
    known &= view.grey > 0
    wanted *= known
    grey = np.where(known, view.grey, 0).astype(np.float32)
    around = (cv2.blur(image, (_EVEN_PX, _EVEN_PX)) for image in (grey, wanted))  # both know the same pixels
    wanted *= np.clip(np.divide(*(np.maximum(image, 1) for image in around)), 0.3, 3)
    first, second = (np.clip(image, 0, 255).astype(np.uint8) for image in (wanted, grey))
    reach = 2 * _INSIDE_PX + 1
    inside = cv2.erode(known.astype(np.uint8), np.ones((reach, reach), np.uint8), borderValue=0)
    usable = (inside > 0) & (texture(first) > TEXTURE)
    cells = np.floor(points).astype(np.int64)
    height, width = view.grey.shape
    moved = np.full(points.shape, np.nan)
    column, row = np.clip(cells, 0, [width - 1, height - 1]).T
    chosen = np.flatnonzero((cells == np.stack([column, row], 1)).all(1) & usable[row, column])
    if not len(chosen):
        return moved
    start = (points[chosen] - 0.5).astype(np.float32)
    rough, rough_gap = tracked(first, second, start, start, **_COARSE)
    ends, gap = tracked(first, second, start, rough, **LUCAS_KANADE)
    good = (rough_gap < 2 * _MAX_GAP) & (gap < _MAX_GAP) & (np.linalg.norm(ends - rough, axis=1) < _MAX_CHANGE)
    moved[chosen[good]] = (ends - start)[good]
    return moved


@numba.njit(cache=True, nogil=True)
def _shares(x, y, points, face):
    """Barycentric coordinates of a pixel in a face."""
    ax, ay = points[face[0], 0], points[face[0], 1]
    bx, by = points[face[1], 0], points[face[1], 1]
    cx, cy = points[face[2], 0], points[face[2], 1]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
    v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
    return u, v, 1 - u - v


@numba.njit(cache=True, nogil=True)
def _mixed(u, v, w, points, face):
    """The point of a face with these barycentric coordinates."""
    i, j, k = face[0], face[1], face[2]
    x = u * points[i, 0] + v * points[j, 0] + w * points[k, 0]
    y = u * points[i, 1] + v * points[j, 1] + w * points[k, 1]
    return x, y, u * points[i, 2] + v * points[j, 2] + w * points[k, 2]


@numba.njit(cache=True, nogil=True)
def _depth(nearest, faces, points):
    """Depths [h, w], m, of the faces ``nearest``; infinite without one."""
    depth = np.full(nearest.shape, np.inf, np.float32)
    for row in range(nearest.shape[0]):
        for column in range(nearest.shape[1]):
            if nearest[row, column] >= 0:
                face = faces[nearest[row, column]]
                u, v, w = _shares(column + 0.5, row + 0.5, points, face)
                depth[row, column] = _mixed(u, v, w, points, face)[2]
    return depth


@numba.njit(cache=True, nogil=True)
def _add_other(nearest, faces, points, other_points, other_depth, other_grey, other_facing, total, weight, count):
    """Add to ``total``, ``weight`` and ``count`` what another frame shows of the faces at each pixel."""
    height, width = other_grey.shape
    for row in range(nearest.shape[0]):
        for column in range(nearest.shape[1]):
            number = nearest[row, column]
            if number < 0 or other_facing[number] < FACING:
                continue
            face = faces[number]
            u, v, w = _shares(column + 0.5, row + 0.5, points, face)
            x, y, z = _mixed(u, v, w, other_points, face)
            left, top = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
            if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
                continue
            if not abs(z - other_depth[int(y), int(x)]) < _SAME_M:
                continue
            one, two = other_grey[top, left], other_grey[top, left + 1]
            three, four = other_grey[top + 1, left], other_grey[top + 1, left + 1]
            if one == 0 or two == 0 or three == 0 or four == 0:
                continue
            s, t = x - 0.5 - left, y - 0.5 - top
            value = (1 - t) * ((1 - s) * one + s * two) + t * ((1 - s) * three + s * four)
            share = other_facing[number] ** 2
            total[row, column] += share * value
            weight[row, column] += share
            count[row, column] += 1
