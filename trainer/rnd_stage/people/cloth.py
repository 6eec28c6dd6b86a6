"""Cloth by position-based dynamics of points on the garments.

Müller et al., "Position based dynamics" (2007) with the compliance and small steps of Macklin et al. (XPBD, 2016;
"Small steps", 2019). Points are about a centimetre apart. Springs to their neighbours, a little longer than at rest,
resist stretching; weak ones across resist bending. Each point is tied softly to its skinned position, stays within its
own radius of it, above the plane of the skin and outside the legs' capsules. Gravity and the skinned motion move the
cloth, so that folds depend on pose and history. Cloth does not collide with cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SPACING = 0.010  # m between simulated points
SUBSTEPS = 10  # a frame at 30 fps
WARM_UP = 1.0  # s: from the rest pose into the first pose, then hanging still
GRAVITY = 9.81
STRETCH, BEND = 2e-8, 2e-5  # compliances, m/N for a unit mass
TIE = 6e-4  # of the pull towards the skinned position where the radius is 2 cm; grows with the square of the radius
DRAG = 6.0  # 1/s, towards the skinned position's velocity
SKIN_GAP = 0.003  # m that stays between cloth and body
NEIGHBOURS = 4  # simulated points a vertex follows
NEAR = 1.75 * SPACING  # m within which points are neighbours in the weave
MIN_SPRINGS = 3


@dataclass(frozen=True, eq=False)
class Drape:
    """How a garment's vertices may move: all [V].

    Attributes:
        radius: m, the farthest a vertex moves from its skinned position; 0 for skin.
        gap: m between the garment and the body below it, at rest.
        slack: share by which its springs are longer than at rest.
        piece: garments of different numbers are not joined.
        hangs: what falls free of the legs and only meets them as capsules.
    """

    radius: Floats
    gap: Floats
    slack: Floats
    piece: Ints
    hangs: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Capsules:
    """Legs as capsules: the joints that carry them [C], their ends at rest [C, 2, 3] m, their radii [C] m."""

    joints: Ints
    ends: Floats
    radii: Floats


class Cloth:
    """The simulated points of one dressed surface.

    Args:
        vertices, normals: [V, 3] of the surface at rest; weights: [V, J] of its skinning.
        drape: how it may move.
    """

    def __init__(
        self, vertices: Floats, normals: Floats, weights: Floats, drape: Drape, capsules: Capsules, seed: int = 0
    ) -> None:
        free = np.flatnonzero((drape.radius > 0) & (drape.gap > SKIN_GAP))
        chosen = free[_sampled(vertices[free], SPACING, seed)]
        chosen = chosen[_connected(vertices[chosen], normals[chosen], drape.piece[chosen])]
        self.rest, self.normals, self.weights = vertices[chosen], normals[chosen], weights[chosen]
        self.radius, self.gap, self.hangs = drape.radius[chosen], drape.gap[chosen], drape.hangs[chosen]
        self.capsules = capsules
        self.springs = _springs(self.rest, self.normals, drape.slack[chosen], drape.piece[chosen])
        self.follows, self.shares = _interpolation(vertices, drape, self.rest, drape.piece[chosen])

    def simulate(self, bones: NDArray[np.float32], fps: float, keep: list[int]) -> dict[int, Floats]:
        """Displacements [P, 3] m from the skinned positions, of the frames ``keep``.

        Args:
            bones: [F, J, 3, 4] what skins each frame, from the first on; the person comes out of the rest pose before.
        """
        warm = max(2, round(WARM_UP * fps))
        identity = np.broadcast_to(np.eye(3, 4), bones.shape[1:])
        first, first_normals = self._skinned(bones[0])
        start, start_normals = self._skinned(identity)
        start = start + first.mean(axis=0) - start.mean(axis=0)  # moved, not dragged, to where the motion begins
        rotation = _best_rotation(start, first)
        middle = first.mean(axis=0)
        start, start_normals = (start - middle) @ rotation.T + middle, start_normals @ rotation.T
        points, velocity = start.copy(), np.zeros_like(start)
        before = start, start_normals
        result = {}
        for step in range(-warm, len(bones)):
            if step < 0:
                t = min(1.0, 2 * (step + warm + 1) / warm)
                now, now_normals = (start + t * (first - start), start_normals + t * (first_normals - start_normals))
                segments = self._segments(bones[0]) if t >= 1 else np.zeros((0, 2, 3))
            else:
                now, now_normals = self._skinned(bones[step])
                segments = self._segments(bones[step])
            after = now, now_normals
            bounds, body = (self.radius, self.gap, self.hangs), (segments, self.capsules.radii)
            _advance(points, velocity, before, after, self.springs, bounds, body, 1.0 / fps)
            before = after
            if step in keep:
                result[step] = points - now
            if step == max(keep):
                break
        return result

    def displaced(self, skinned: Floats, displacement: Floats) -> Floats:
        """Skinned vertices [V, 3] moved along with the points: ``displacement`` [P, 3]."""
        moved = skinned.copy()
        free = self.shares[:, 0] > 0
        moved[free] += np.einsum("vk,vkc->vc", self.shares[free], displacement[self.follows[free]])
        return moved

    def _skinned(self, bones: NDArray[np.floating]) -> tuple[Floats, Floats]:
        blend = np.tensordot(self.weights, np.asarray(bones, np.float64), axes=1)
        points = np.einsum("vij,vj->vi", blend[:, :, :3], self.rest) + blend[:, :, 3]
        normals = np.einsum("vij,vj->vi", blend[:, :, :3], self.normals)
        return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)

    def _segments(self, bones: NDArray[np.float32]) -> Floats:
        carried = bones[self.capsules.joints].astype(np.float64)
        return np.einsum("cij,ckj->cki", carried[:, :, :3], self.capsules.ends) + carried[:, None, :, 3]


def _sampled(points: Floats, spacing: float, seed: int) -> Ints:
    """Indices of a subset of ``points`` at least ``spacing`` apart that leaves no larger hole (dart throwing)."""
    order = np.random.default_rng(seed).permutation(len(points))
    near = cKDTree(points).query_ball_point(points, spacing)
    taken, blocked = [], np.zeros(len(points), bool)
    for i in order:
        if not blocked[i]:
            taken.append(i)
            blocked[near[i]] = True
    return np.sort(np.array(taken, np.int64))


def _springs(points: Floats, normals: Floats, slack: Floats, piece: Ints) -> tuple[Ints, Floats, Floats]:
    """Pairs [S, 2], their lengths [S] m and compliances [S]; shuffled once, so that no direction is solved first."""
    pairs = cKDTree(points).query_pairs(2.6 * SPACING, output_type="ndarray")
    i, j = pairs.T
    length = np.linalg.norm(points[i] - points[j], axis=1)
    same = _same_sheet(pairs, normals, piece)
    near, across = length < NEAR, length > 2.1 * SPACING
    keep = same & (near | across)
    pairs, length, near = pairs[keep], length[keep], near[keep]
    mean_slack = 0.5 * (slack[pairs[:, 0]] + slack[pairs[:, 1]])
    length = length * np.where(near, 1 + mean_slack, 1 + 0.5 * mean_slack)
    order = np.random.default_rng(0).permutation(len(pairs))
    return pairs[order].astype(np.int64), length[order], np.where(near, STRETCH, BEND)[order]


def _connected(points: Floats, normals: Floats, piece: Ints) -> NDArray[np.bool_]:
    """Which points [P] have enough neighbours to hold them: a rim that faces another way would dangle from its edge."""
    pairs = cKDTree(points).query_pairs(NEAR, output_type="ndarray")
    pairs = pairs[_same_sheet(pairs, normals, piece)]
    return np.bincount(pairs.ravel(), minlength=len(points)) >= MIN_SPRINGS


def _same_sheet(pairs: Ints, normals: Floats, piece: Ints) -> NDArray[np.bool_]:
    i, j = pairs.T
    return (piece[i] == piece[j]) & (np.sum(normals[i] * normals[j], axis=1) > 0.3)


def _interpolation(vertices: Floats, drape: Drape, points: Floats, piece: Ints) -> tuple[Ints, Floats]:
    """Which simulated points [V, 4] each vertex follows, and by how much [V, 4]; rows of zeros where it does not."""
    follows = np.zeros((len(vertices), NEIGHBOURS), np.int64)
    shares = np.zeros((len(vertices), NEIGHBOURS))
    for number in np.unique(piece):
        here = np.flatnonzero((drape.piece == number) & (drape.radius > 0))
        there = np.flatnonzero(piece == number)
        gaps, index = cKDTree(points[there]).query(vertices[here], k=NEIGHBOURS)
        kernel = np.exp(-((gaps / SPACING) ** 2)) + 1e-9
        follows[here] = there[np.minimum(index, len(there) - 1)]
        shares[here] = kernel / kernel.sum(axis=1, keepdims=True)
    return follows, shares


def _best_rotation(source: Floats, target: Floats) -> Floats:
    """Rotation [3, 3] about the vertical that turns ``source`` onto ``target`` best (both centred)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    angle = np.arctan2((a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum(), (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]).sum())
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@njit(cache=True)
def _advance(x, v, before, now, springs, bounds, body, duration):
    """One frame of ``SUBSTEPS`` small steps: positions ``x`` and velocities ``v`` [P, 3], changed in place.

    Args:
        before, now: skinned positions and normals [P, 3] at the frame's start and end.
        springs: pairs [S, 2], lengths [S] m, compliances [S].
        bounds: how far each point may move m, its gap to the body m, whether it hangs free of a limb, [P] each.
        body: axes [C, 2, 3] and radii [C] m of the capsules.
        duration: s.
    """
    dt = duration / SUBSTEPS
    old = np.empty_like(x)
    radius, gap, hangs = bounds
    for sub in range(SUBSTEPS):
        t = (sub + 1.0) / SUBSTEPS
        _fall(x, v, old, before[0], now[0], duration, dt)
        _pull(x, springs, dt)
        for i in range(len(x)):
            anchor, normal = _between(before[0], now[0], i, t), _between(before[1], now[1], i, t)
            tie = 1.0 / (1.0 + TIE * (radius[i] / 0.02) ** 2 / (dt * dt))
            dx, dy, dz = x[i, 0] - anchor[0], x[i, 1] - anchor[1], x[i, 2] - anchor[2]
            px, py, pz = x[i, 0] - dx, x[i, 1] - dy, x[i, 2] - dz
            away = dx * (1 - tie), dy * (1 - tie), dz * (1 - tie)
            away = _above_skin(away, normal, gap[i])
            if hangs[i]:  # sleeves and legs have their planes
                for c in range(len(body[0])):
                    away = _out_of(body[0][c], body[1][c], (px, py, pz), away, normal)
            away = _within(away, radius[i])
            x[i, 0], x[i, 1], x[i, 2] = px + away[0], py + away[1], pz + away[2]
            for c in range(3):
                v[i, c] = (x[i, c] - old[i, c]) / dt


@njit(inline="always")
def _fall(x, v, old, before, now, duration, dt):
    """Air that moves with the body drags, and weight pulls; the positions at which the step began go to ``old``."""
    drag = 1.0 - np.exp(-DRAG * dt)
    for i in range(len(x)):
        for c in range(3):
            swept = (now[i, c] - before[i, c]) / duration
            v[i, c] += drag * (swept - v[i, c])
            old[i, c] = x[i, c]
        v[i, 1] -= GRAVITY * dt
        for c in range(3):
            x[i, c] += v[i, c] * dt


@njit(inline="always")
def _pull(x, springs, dt):
    """Each spring in turn towards its length, as far as its compliance lets it (XPBD, one iteration)."""
    pairs, lengths, compliances = springs
    for s in range(len(pairs)):
        i, j = pairs[s, 0], pairs[s, 1]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12
        move = -(length - lengths[s]) / (2.0 + compliances[s] / (dt * dt)) / length
        x[i, 0] += move * dx
        x[i, 1] += move * dy
        x[i, 2] += move * dz
        x[j, 0] -= move * dx
        x[j, 1] -= move * dy
        x[j, 2] -= move * dz


@njit(inline="always")
def _between(a, b, i, t):
    return (a[i, 0] + t * (b[i, 0] - a[i, 0]), a[i, 1] + t * (b[i, 1] - a[i, 1]), a[i, 2] + t * (b[i, 2] - a[i, 2]))


@njit(inline="always")
def _above_skin(away, normal, gap):
    """A displacement that does not reach through the skin below."""
    dx, dy, dz = away
    nx, ny, nz = normal
    deep = -(gap - SKIN_GAP) - (dx * nx + dy * ny + dz * nz)
    if deep > 0.0:
        dx += deep * nx
        dy += deep * ny
        dz += deep * nz
    return dx, dy, dz


@njit(inline="always")
def _out_of(axis, radius, anchor, away, normal):
    """A displacement from ``anchor`` that does not end inside a capsule."""
    dx, dy, dz = away
    ax, ay, az = axis[0, 0], axis[0, 1], axis[0, 2]
    bx, by, bz = axis[1, 0] - ax, axis[1, 1] - ay, axis[1, 2] - az
    qx, qy, qz = anchor[0] + dx - ax, anchor[1] + dy - ay, anchor[2] + dz - az
    share = (qx * bx + qy * by + qz * bz) / (bx * bx + by * by + bz * bz)
    share = min(max(share, 0.0), 1.0)
    ex, ey, ez = qx - share * bx, qy - share * by, qz - share * bz
    inside = radius * radius - (ex * ex + ey * ey + ez * ez)
    if inside > 0.0:
        # out of the leg and away from the body: straight out of the axis would tear a skirt at a knee
        mx, my, mz = ex + 2 * radius * normal[0], ey + 2 * radius * normal[1], ez + 2 * radius * normal[2]
        norm = np.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx / norm, my / norm, mz / norm
        along = ex * mx + ey * my + ez * mz
        push = np.sqrt(along * along + inside) - along
        dx += push * mx
        dy += push * my
        dz += push * mz
    return dx, dy, dz


@njit(inline="always")
def _within(away, radius):
    """A displacement no longer than ``radius``."""
    dx, dy, dz = away
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length > radius:
        shrink = radius / length
        dx, dy, dz = dx * shrink, dy * shrink, dz * shrink
    return dx, dy, dz
