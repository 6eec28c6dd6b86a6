"""Body template: evenly spaced surface points, nodes among them, interpolation between nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.capture.body import Body, skin
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.skeleton import bone_transforms

from .twist import twist_frames

Floats = NDArray[np.float64]

NEIGHBOURS = 4
"""nodes that a Gaussian interpolates between"""
OVERSAMPLING = 6
"""candidates per point of farthest point sampling: spacing within 10 % of the best at 6, no better at 12"""
WEIGHT_FLOOR = 1e-6
"""smallest template weight before the logarithm; moves a point by less than 0.1 mm"""
BUCKET = 128
"""candidates per bounding box; 64 and 512 take a third longer"""
CURVE_BITS = 10
"""bits of a cell's index along an axis: cells of 2 mm"""
SPREAD = {
    "left_hip": (0, 0, 0.35),
    "right_hip": (0, 0, -0.35),
    "left_shoulder": (0, 0, -0.35),
    "right_shoulder": (0, 0, 0.35),
}
"""pose of the encoded positions (axis-angle, rad); separates neighbours at armpits and crotch"""


@dataclass(frozen=True, eq=False)
class Template:
    """N surface points of a body in its rest pose; the first M are the nodes."""

    points: Floats  # [N, 3] m
    normals: Floats  # [N, 3] unit
    codes: Floats  # [N, 3] m, encoded positions: points in the spread pose
    weights: Floats  # [N, J] skinning weights
    spacing: float  # m, mean distance of neighbouring Gaussians
    neighbours: NDArray[np.int64]  # [N, 4] nodes of the interpolation
    neighbour_weights: Floats  # [N, 4], rows sum to 1
    limbs: tuple[Floats, Floats, Floats]  # axes [N, 3], levers [N, 3], shares [N] of ``model.twist.TwistFrames``
    nodes: int  # M


def sample_template(body: Body, count: int, nodes: int, seed: int) -> Template:
    """Sample ``count`` evenly spaced points of the surface of ``body``.

    Farthest point sampling (Eldar et al. 1997) of uniform candidates: every prefix covers the body.

    Raises:
        InputError: too few or too many ``nodes``, or the body has no surface.
    """
    if not 16 <= nodes <= count:
        raise InputError("nodes", expected=f"16 to {count} (the number of Gaussians)", got=nodes)
    vertices = np.asarray(body.vertices, np.float64)
    triangles = vertices[body.faces]
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = 0.5 * np.linalg.norm(crosses, axis=1)
    area = float(areas.sum())
    if not 0 < area < np.inf:
        raise InputError("faces of the body", expected="a surface", got=f"{len(areas)} faces, {area:.3g} m²")
    rng = np.random.default_rng(seed)
    face = rng.choice(len(areas), size=OVERSAMPLING * count, p=areas / area)
    u, v = rng.random((2, len(face)))
    flip = u + v > 1
    u[flip], v[flip] = 1 - u[flip], 1 - v[flip]
    barycentric = np.stack([1 - u - v, u, v], axis=1)  # [C, 3]

    def interpolate(values: Floats) -> Floats:
        return np.einsum("ck,ck...->c...", barycentric, values[body.faces[face]])

    weights = interpolate(np.asarray(body.skinning_weights, np.float64))
    candidates = interpolate(vertices)
    spread = np.zeros((len(body.skeleton.names), 3))
    for joint, rotation in SPREAD.items():
        if joint in body.skeleton.names:  # other skeletons: the rest pose
            spread[body.skeleton.names.index(joint)] = rotation
    bones = bone_transforms(body.skeleton, axis_angle_to_matrix(spread), np.zeros(3)).astype(np.float64)
    codes = skin(candidates, weights, bones)

    chosen = farthest_points(codes.astype(np.float32), count, int(rng.integers(len(codes))))
    codes, points, weights = codes[chosen], candidates[chosen], weights[chosen]
    normals = interpolate(_vertex_normals(vertices, body.faces, crosses))[chosen]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    neighbours, neighbour_weights = node_interpolation(codes, codes[:nodes], area)
    weights = weights / weights.sum(axis=1, keepdims=True)
    return Template(
        points=points,
        normals=normals,
        codes=codes,
        weights=weights,
        spacing=float(np.sqrt(area / count)),
        neighbours=neighbours,
        neighbour_weights=neighbour_weights,
        limbs=twist_frames(points, weights, body.skeleton),
        nodes=nodes,
    )


def node_interpolation(codes: Floats, nodes: Floats, area: float) -> tuple[NDArray[np.int64], Floats]:
    """Nearest ``nodes`` [M, 3] m of ``codes`` [N, 3] m and their weights, both [N, 4]; rows sum to 1.

    ``area`` [m²] of the surface gives the spacing of the nodes, which scales the kernel.
    """
    distances, neighbours = cKDTree(nodes).query(codes, k=min(NEIGHBOURS, len(nodes)))
    kernel = 1.0 / (distances**2 + (0.3 * float(np.sqrt(area / len(nodes)))) ** 2)
    return neighbours.astype(np.int64), kernel / kernel.sum(axis=1, keepdims=True)


def z_curve_order(points: Floats) -> NDArray[np.int64]:
    """Indices [N] of ``points`` [N, 3] m along a Z-curve (Morton 1966), stable within a cell."""
    low = points.min(axis=0, initial=np.inf)
    extent = max(float((points - low).max(initial=0)), 1e-9)
    cells = ((points - low) * ((1 << CURVE_BITS) - 1) / extent).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            keys |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(keys, kind="stable")


def _vertex_normals(vertices: Floats, faces: NDArray[np.int32], crosses: Floats) -> Floats:
    """Area-weighted vertex normals [V, 3]; not normalised where a vertex has no face."""
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crosses)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def farthest_points(points: NDArray[np.float32], count: int, first: int) -> NDArray[np.int64]:
    """Indices [count] of a farthest point ordering of ``points`` [C, 3] that starts with ``first``.

    Ties go to the lowest index. Bounding boxes of buckets skip points far from the newest one, as in QuickFPS (Han et
    al. 2023); the ordering is that of exhaustive search.
    """
    curve = z_curve_order(points.astype(np.float64))
    return _farthest_along(points[curve], curve, count, int(np.flatnonzero(curve == first)[0]))


@numba.njit(cache=True)
def _farthest_along(points, indices, count, first):
    """``farthest_points`` of ``points`` [C, 3] sorted along a curve; ``indices`` [C] are the original ones."""
    candidates = points.shape[0]
    buckets = (candidates + BUCKET - 1) // BUCKET
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    low, high = np.empty((3, buckets), np.float32), np.empty((3, buckets), np.float32)
    for b in range(buckets):
        for axis in range(3):
            inside = points[b * BUCKET : (b + 1) * BUCKET, axis]
            low[axis, b], high[axis, b] = inside.min(), inside.max()
    nearest = np.full(candidates, np.float32(np.inf))  # m², to the points chosen so far
    reach = np.full(buckets, np.float32(np.inf))  # m², maximum of `nearest` in a bucket, at index `at`
    at = np.zeros(buckets, np.int64)
    bound = np.empty(buckets, np.float32)
    zero = np.float32(0)
    order = np.empty(count, np.int64)
    current = first
    for k in range(count):
        order[k] = indices[current]
        cx, cy, cz = x[current], y[current], z[current]
        for b in range(buckets):  # rounding is monotone: a lower bound for all points of the box in float32
            dx = max(max(low[0, b] - cx, cx - high[0, b]), zero)
            dy = max(max(low[1, b] - cy, cy - high[1, b]), zero)
            dz = max(max(low[2, b] - cz, cz - high[2, b]), zero)
            bound[b] = dx * dx + dy * dy + dz * dz
        current = -1
        for b in range(buckets):
            if bound[b] < reach[b]:
                start, end = b * BUCKET, min((b + 1) * BUCKET, candidates)
                for i in range(start, end):
                    dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
                    nearest[i] = min(nearest[i], dx * dx + dy * dy + dz * dz)
                farthest = start
                for i in range(start + 1, end):
                    if _beyond(nearest[i], indices[i], nearest[farthest], indices[farthest]):
                        farthest = i
                reach[b], at[b] = nearest[farthest], farthest
            if current < 0 or _beyond(reach[b], indices[at[b]], nearest[current], indices[current]):
                current = at[b]
    return order


@numba.njit(cache=True, inline="always")
def _beyond(distance, index, other, other_index):
    """Whether a point precedes another: the farther one, or of equals the one with the lower index."""
    return distance > other or (distance == other and index < other_index)
