"""Cloth by position-based dynamics of points on the garments, 1 cm apart.

Springs to neighbours resist stretching, weak ones to the next neighbours bending. Each point is softly attached to its
skinned position, within a radius of it, above the plane of the skin and outside the legs' capsules. Cloth does not
collide with cloth.

Source: Müller et al., "Position based dynamics" (2007); Macklin et al., XPBD (2016) and "Small steps" (2019).
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
WARM_UP = 1.0  # s: from the rest pose to the first pose, then at rest
GRAVITY = 9.81
STRETCH, BEND = 2e-8, 2e-5  # compliances, m/N for a unit mass
TIE = 6e-4  # compliance of the attachment for a radius of 2 cm; proportional to the radius squared
DRAG = 6.0  # 1/s, towards the skinned position's velocity
SKIN_GAP = 0.003  # m; least distance of cloth and body
NEIGHBOURS = 4  # simulated points that move a vertex
NEAR = 1.75 * SPACING  # m; largest distance of neighbours
MIN_SPRINGS = 3


@dataclass(frozen=True, eq=False)
class Drape:
    """Limits of the motion of a garment's vertices: all [V].

    Attributes:
        radius: m, largest distance from the skinned position; 0 for skin.
        gap: m between the garment and the body at rest.
        slack: share by which springs are longer than at rest.
        piece: garments of different numbers are not connected.
        hangs: vertices that collide with the legs' capsules.
    """

    radius: Floats
    gap: Floats
    slack: Floats
    piece: Ints
    hangs: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Capsules:
    """Legs as capsules: their joints [C], ends at rest [C, 2, 3] m, radii [C] m."""

    joints: Ints
    ends: Floats
    radii: Floats


class Cloth:
    """The simulated points of a surface with ``vertices`` and ``normals`` [V, 3] at rest and ``weights`` [V, J]."""

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
        """Displacements [P, 3] m from the skinned positions in the frames ``keep``; ``bones`` [F, J, 3, 4]."""
        warm = max(2, round(WARM_UP * fps))
        identity = np.broadcast_to(np.eye(3, 4), bones.shape[1:])
        first, first_normals = self._skinned(bones[0])
        start, start_normals = self._skinned(identity)
        start = start + first.mean(axis=0) - start.mean(axis=0)
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
        """Skinned vertices [V, 3] moved by the points' ``displacement`` [P, 3]."""
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
    """Indices of a maximal subset of ``points`` at least ``spacing`` apart (dart throwing)."""
    order = np.random.default_rng(seed).permutation(len(points))
    near = cKDTree(points).query_ball_point(points, spacing)
    taken, blocked = [], np.zeros(len(points), bool)
    for i in order:
        if not blocked[i]:
            taken.append(i)
            blocked[near[i]] = True
    return np.sort(np.array(taken, np.int64))


def _springs(points: Floats, normals: Floats, slack: Floats, piece: Ints) -> tuple[Ints, Floats, Floats]:
    """Pairs [S, 2], lengths [S] m and compliances [S], shuffled to avoid a bias of direction."""
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
    """Whether points [P] have at least ``MIN_SPRINGS`` neighbours of the same sheet."""
    pairs = cKDTree(points).query_pairs(NEAR, output_type="ndarray")
    pairs = pairs[_same_sheet(pairs, normals, piece)]
    return np.bincount(pairs.ravel(), minlength=len(points)) >= MIN_SPRINGS


def _same_sheet(pairs: Ints, normals: Floats, piece: Ints) -> NDArray[np.bool_]:
    i, j = pairs.T
    return (piece[i] == piece[j]) & (np.sum(normals[i] * normals[j], axis=1) > 0.3)


def _interpolation(vertices: Floats, drape: Drape, points: Floats, piece: Ints) -> tuple[Ints, Floats]:
    """The simulated points [V, 4] that move each vertex and their weights [V, 4], zero for fixed vertices."""
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
    """Least-squares rotation [3, 3] about the vertical of ``source`` onto ``target``, both centred."""
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
        bounds: radius m, gap m and hangs of ``Drape``, [P] each.
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
            if hangs[i]:
                for c in range(len(body[0])):
                    away = _out_of(body[0][c], body[1][c], (px, py, pz), away, normal)
            away = _within(away, radius[i])
            x[i, 0], x[i, 1], x[i, 2] = px + away[0], py + away[1], pz + away[2]
            for c in range(3):
                v[i, c] = (x[i, c] - old[i, c]) / dt


@njit(inline="always")
def _fall(x, v, old, before, now, duration, dt):
    """Drag by air that moves with the body, and gravity; the positions before the step go to ``old``."""
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
    """One XPBD iteration over the springs."""
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
    """The displacement, limited to the outside of the skin's plane."""
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
    """The displacement from ``anchor``, limited to the outside of a capsule."""
    dx, dy, dz = away
    ax, ay, az = axis[0, 0], axis[0, 1], axis[0, 2]
    bx, by, bz = axis[1, 0] - ax, axis[1, 1] - ay, axis[1, 2] - az
    qx, qy, qz = anchor[0] + dx - ax, anchor[1] + dy - ay, anchor[2] + dz - az
    share = (qx * bx + qy * by + qz * bz) / (bx * bx + by * by + bz * bz)
    share = min(max(share, 0.0), 1.0)
    ex, ey, ez = qx - share * bx, qy - share * by, qz - share * bz
    inside = radius * radius - (ex * ex + ey * ey + ez * ez)
    if inside > 0.0:
        # a push along the axis' normal alone would tear a skirt at a knee
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
    """The displacement, limited to ``radius``."""
    dx, dy, dz = away
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length > radius:
        shrink = radius / length
        dx, dy, dz = dx * shrink, dy * shrink, dz * shrink
    return dx, dy, dz
