"""Coarser versions of an avatar, for bodies of few pixels: networks at fewer nodes, and merged pairs of Gaussians.

Pairs are neighbours, the most alike first. Of a pair the positions, covariances and materials are merged by moments,
weighted by opacity times area; the heavier one gives the skinning. Discs then grow in their plane, by as much as
keeps the coverage of the body.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .rest import RestPose

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

KEPT = 0.985
"""share of the Gaussians that the next coarser level keeps"""
CULLED_LEVELS = ((4, -0.6), (16, -0.5), (32, -0.4))
"""of the first levels: nodes for each one that is kept, and the n·v below which Gaussians are left out; each 0.9 to
1/255 from the one before, at any size"""
PARTNER_WINDOW = 96  # Gaussians along a space-filling curve among which a partner is searched
MIN_COSINE = 0.6  # of the normals of a pair
PARTNER_REACH = 2.5  # median distances to the nearest neighbour on the same side that a pair may be apart
COLOUR_WEIGHT = 50.0  # of squared differences of albedo, against squared distances
GROWTH = 0.5  # exponent: when 40 % are left, a body has lost 1 % of its coverage at 0 and gained 1 % at 0.5
MIN_GAUSSIANS = 1500
"""of a level that has a coarser one"""
ROWS_AT_HAND = 750_000
"""of all levels of an avatar, 0.4 GB once they are posed: a crowd that walks to and fro takes a hundred levels"""
_CURVE_BITS = 10  # of a coordinate on the curve
_NOWHERE = 1e3  # m
_CHUNK = 1024  # Gaussians whose distances to all nodes are kept at once


def on_fewer_nodes(rest: RestPose, kept: NDArray[np.int64]) -> RestPose:
    """``rest`` interpolated between the nodes ``kept`` alone; each is where the Gaussians are that use it."""
    points, used = rest.points.astype(np.float64), rest.neighbours.ravel()
    weights = rest.neighbour_weights.ravel().astype(np.float64)
    each = np.repeat(points, rest.neighbours.shape[1], axis=0)
    sums = [np.bincount(used, weights * values, kept.max() + 1) for values in (*each.T, np.ones(len(each)))]
    with np.errstate(divide="ignore", invalid="ignore"):
        nodes = np.stack(sums[:3], axis=1)[kept] / sums[3][kept, None]
    nodes[~np.isfinite(nodes)] = _NOWHERE  # no Gaussian uses it
    count = min(rest.neighbours.shape[1], len(kept))
    neighbours, squares = [], []
    for part in np.array_split(points, len(points) // _CHUNK + 1):
        distances = (part**2).sum(axis=1)[:, None] + (nodes**2).sum(axis=1) - 2 * part @ nodes.T
        nearest = np.argpartition(distances, count - 1, axis=1)[:, :count]
        neighbours.append(nearest)
        squares.append(np.take_along_axis(distances, nearest, axis=1))
    distances = np.concatenate(squares)
    kernel = 1 / (distances + distances.min(axis=1).mean())
    shares = (kernel / kernel.sum(axis=1, keepdims=True)).astype(np.float32)
    return replace(rest, neighbours=np.concatenate(neighbours).astype(np.int32), neighbour_weights=shares)


_ROWS = ("neighbours", "neighbour_weights", "log_template", "points", "factors", "normals", "limbs")
"""of a ``RestPose``: one for each Gaussian"""


class Surface(NamedTuple):
    """Unposed Gaussians: ``RestPose``, opacities [N], albedo [N, 3] and roughness [N]."""

    rest: RestPose
    opacities: Floats32
    albedo: Floats32
    roughness: Floats32


class MergedLevels:
    """Levels of ``surface``, each with ``KEPT`` of the Gaussians of the one before, or more where too few are alike.

    Level 0 is ``surface``. A merged pair becomes one more row of common arrays, and a level is a list of rows; no more
    than ``ROWS_AT_HAND`` of the levels' own arrays are kept.
    """

    def __init__(self, surface: Surface) -> None:
        count = len(surface.opacities)
        self._rows = [np.arange(count)]
        self._pool, self._used = _taken(surface, np.arange(2 * count) % count), count
        self._at_hand = {0: surface}

    def count(self, level: int) -> int | None:
        """Number of the Gaussians of ``level``; None where there is none."""
        while len(self._rows) <= level:
            if len(self._rows[-1]) <= MIN_GAUSSIANS or not self._add():
                return None
        return len(self._rows[level])

    def surface(self, level: int) -> Surface:
        """A level that there is."""
        if level in self._at_hand:
            found = self._at_hand[level] = self._at_hand.pop(level)  # now the latest
            return found
        found = self._at_hand[level] = _taken(self._pool, self._rows[level])
        rows = 0
        for other in reversed([*self._at_hand]):
            rows += len(self._rows[other])
            if other not in (0, level) and rows > ROWS_AT_HAND:
                del self._at_hand[other]
        return found

    def _add(self) -> bool:
        """Merge the most alike pairs of the last level; False where none are alike."""
        rows = self._rows[-1]
        places = (self._pool.rest.points[rows], self._pool.rest.normals[rows], self._pool.albedo[rows])
        a, b = _pairs(*(values.astype(np.float64) for values in places))
        if not len(a):
            return False
        new = np.arange(self._used, self._used + len(a))
        merged = merged_pairs(self._pool, rows[a], rows[b])
        for name in _ROWS:
            getattr(self._pool.rest, name)[new] = getattr(merged.rest, name)
        for ours, theirs in zip(self._pool[1:], merged[1:]):
            ours[new] = theirs
        self._used += len(a)
        fewer = rows.copy()
        fewer[a] = new
        self._rows.append(np.delete(fewer, b))
        return True


def _taken(surface: Surface, rows: NDArray[np.int64]) -> Surface:
    """The Gaussians ``rows`` of ``surface``."""
    rest = replace(surface.rest, **{name: getattr(surface.rest, name)[rows] for name in _ROWS})
    return Surface(rest, *(values[rows] for values in surface[1:]))


def merged_pairs(surface: Surface, a: NDArray[np.int64], b: NDArray[np.int64]) -> Surface:
    """Gaussians in place of the pairs of rows ``a`` and ``b`` of ``surface``."""
    (one, opacities, albedo, roughness), (other, *others) = _taken(surface, a), _taken(surface, b)
    first, second = _covariances(one.factors), _covariances(other.factors)
    areas = _areas(_variances(first)), _areas(_variances(second))
    weights = [np.maximum(area * values, 1e-30) for area, values in zip(areas, (opacities, others[0]))]
    share = weights[0] / (weights[0] + weights[1])

    def mean(ours: NDArray[np.floating], theirs: NDArray[np.floating]) -> Floats:
        own = share.reshape(-1, *[1] * (ours.ndim - 1))
        return np.asarray(own * ours + (1 - own) * theirs, np.float64)

    apart = (other.points - one.points).astype(np.float64)
    spread = (share * (1 - share))[:, None, None] * apart[:, :, None] * apart[:, None, :]
    variances, axes = np.linalg.eigh(mean(first, second) + spread)
    growth = np.maximum((areas[0] + areas[1]) / np.maximum(_areas(variances), 1e-30), 1) ** GROWTH
    variances = np.maximum(variances, 0) * np.stack([np.ones_like(growth), growth, growth], axis=1)
    normals = mean(one.normals, other.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    heavier = _taken(surface, np.where(share >= 0.5, a, b)).rest
    rest = replace(
        heavier,
        points=mean(one.points, other.points).astype(np.float32),
        factors=(axes * np.sqrt(variances)[:, None, :]).reshape(-1, 9).astype(np.float32),
        normals=normals.astype(np.float32),
    )
    materials = zip((opacities, albedo, roughness), others)
    return Surface(rest, *(mean(ours, theirs).astype(np.float32) for ours, theirs in materials))


def _covariances(factors: Floats32) -> Floats:
    """[P, 3, 3] of factors [P, 9]."""
    square = factors.reshape(-1, 3, 3).astype(np.float64)
    return np.asarray(square @ square.transpose(0, 2, 1), np.float64)


def _variances(covariances: Floats) -> Floats:
    """Ascending [P, 3] along the axes of [P, 3, 3]."""
    return np.asarray(np.linalg.eigvalsh(covariances), np.float64)


def _areas(variances: Floats) -> Floats:
    """σ₁ σ₂ [N] of the two greatest of ascending variances [N, 3]."""
    return np.asarray(np.sqrt(np.maximum(variances[:, 1] * variances[:, 2], 0)))


def _pairs(points: Floats, normals: Floats, albedo: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (a, b) of each pair that is merged."""
    order = _z_curve(points)
    count = len(order)
    partner, cost = np.full(count, -1, np.int64), np.full(count, np.inf)
    _match(points[order], normals[order], albedo[order], partner, cost)
    first = np.flatnonzero(partner > np.arange(count))
    cheapest = first[np.argsort(cost[first], kind="stable")[: round((1 - KEPT) * count)]]
    return order[cheapest], order[partner[cheapest]]


def _z_curve(points: Floats) -> NDArray[np.int64]:
    """Order [N] of ``points`` along a Z-curve (Morton 1966)."""
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    cells = ((points - low) * ((2**_CURVE_BITS - 1) / size)).astype(np.int64)
    codes = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(codes, kind="stable")


@njit(cache=True, nogil=True, error_model="numpy")
def _match(points, normals, albedo, partner, cost):  # type: ignore[no-untyped-def]
    """Fill ``partner`` [N] by the most alike free point within the window, else −1, and its ``cost`` [N] in m²."""
    count = len(points)
    nearest = np.full(count, np.inf)
    for i in range(count):
        for j in range(i + 1, min(i + PARTNER_WINDOW + 1, count)):
            if _cosine(normals[i], normals[j]) > MIN_COSINE:
                square = _squared(points[i], points[j])
                nearest[i], nearest[j] = min(nearest[i], square), min(nearest[j], square)
    reach = PARTNER_REACH * PARTNER_REACH * np.median(nearest)
    for i in range(count):
        if partner[i] >= 0:
            continue
        best, chosen = reach, -1
        for j in range(i + 1, min(i + PARTNER_WINDOW + 1, count)):
            square = _squared(points[i], points[j])
            if partner[j] >= 0 or square >= best:
                continue
            square *= 1.0 + COLOUR_WEIGHT * _squared(albedo[i], albedo[j])
            if square < best and _cosine(normals[i], normals[j]) > MIN_COSINE:
                best, chosen = square, j
        if chosen >= 0:
            partner[i], partner[chosen] = chosen, i
            cost[i] = cost[chosen] = best


@njit(inline="always")
def _squared(a, b):  # type: ignore[no-untyped-def]
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


@njit(inline="always")
def _cosine(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
