"""The clothed surface of an avatar: its template's mesh moved onto its Gaussians, and four skinning weights a vertex.

A vertex is projected onto the Gaussians by moving least squares, then lifted to where grazing lines of sight are half
opaque, since that is where the player's outline is. Weights are those of four joints that follow the avatar's own
posing best, dynamic weights and pose-dependent offsets included.

Source: Alexa et al. 2003, Computing and rendering point set surfaces; Kavan and Sloan 2012 on fitted weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body, skin
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.motion import Motion
from rnd_runtime.posing.window import Moment, moment

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

NEIGHBOURS = 16  # Gaussians that a point is interpolated between
PROJECTIONS = 5
FACING = 0.2  # min cosine between the normals of a point and of a Gaussian that it belongs to
SMOOTHING = 2  # passes over the displacements of neighbouring vertices
SIGHTS, BISECTIONS, MAX_LIFT = 6, 8, 0.03  # lines of sight per vertex, steps, and m, of the search for the outline
JOINTS = 4  # of a vertex
POSES = 24  # of the motion, that weights are fitted to
PRIOR = 1e-6  # m², weight of the avatar's own mean weights in the fit


class Binding(NamedTuple):
    """Gaussians near each of P points and their shares, which sum to 1."""

    neighbours: Indices  # [P, K]
    shares: Floats  # [P, K]

    def of(self, values: NDArray[np.floating]) -> Floats:
        """``values`` [N, …] at the points."""
        mean: Floats = np.einsum("pk,pk...->p...", self.shares, values[self.neighbours].astype(np.float64))
        return mean


class PosedWeights(NamedTuple):
    """The avatar's networks in one pose."""

    bones: Floats  # [J, 3, 4] m, rest pose → root frame
    root: Floats  # [4, 4] m, root frame → world
    at_rest: Gaussians  # with the offsets of the pose
    weights: NDArray[np.float32]  # [N, J]


@dataclass(frozen=True, eq=False)
class Surface:
    """A skinned mesh in the rest pose.

    Attributes:
        vertices: [V, 3] m. faces: [F, 3]. normals: [V, 3] unit.
        binding: of the vertices to ``gaussians``, which are in the rest pose, offsets averaged over the motion.
        weights: [V, J], four of a row not zero.
        error_m: mean distance to the avatar's own posing over the fitted poses.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    normals: Floats
    binding: Binding
    gaussians: Gaussians
    weights: NDArray[np.float32]
    error_m: float

    def posed(self, avatar: Avatar, motion: Motion, time: float) -> Floats:
        """Vertices [V, 3] m in the world at ``time`` s as the avatar itself poses them."""
        pose = posed_weights(avatar, motion, time)
        here = _follow(self.vertices, self.binding, self.gaussians, pose)
        return here @ pose.root[:3, :3].T + pose.root[:3, 3]


def clothed_surface(avatar: Avatar, body: Body, motion: Motion) -> Surface:
    """The ``Surface`` of ``avatar`` on the mesh of ``body``, for ``motion``.

    Raises:
        InputError: the body's joints are not the avatar's.
    """
    if body.skeleton.names != avatar.skeleton.names:
        raise InputError("body", expected="the template of the avatar's capture", got="other joints")
    times = np.linspace(0, motion.duration, min(POSES, motion.frame_count), endpoint=False)
    poses = [posed_weights(avatar, motion, float(time)) for time in times]
    gaussians = _mean_at_rest([pose.at_rest for pose in poses])
    vertices, normals = _projected(body, gaussians, avatar.spacing)
    binding = bind(vertices, normals, gaussians)
    weights, error = _fitted_weights(vertices, binding, gaussians, poses)
    return Surface(vertices, body.faces, normals, binding, gaussians, weights, error)


def posed_weights(avatar: Avatar, motion: Motion, time: float) -> PosedWeights:
    """The networks' outputs at ``time`` s, the Gaussians left in the rest pose."""
    now: Moment = moment(motion, time, avatar.skeleton, poses=avatar.window_poses, seconds=avatar.window_seconds)
    encoded = avatar.encode(motion, time)
    still = np.zeros_like(encoded.bones)
    still[:, :, :3] = np.eye(3)
    (weights,) = avatar.run((now.window, now.velocity, still), ("skinning_weights",))
    at_rest = avatar.posed(encoded._replace(bones=still))
    return PosedWeights(encoded.bones.astype(np.float64), encoded.root, at_rest, weights)


def bind(points: Floats, normals: Floats, gaussians: Gaussians) -> Binding:
    """Bind ``points`` [P, 3] m with ``normals`` [P, 3] to the Gaussians around them that face the same way."""
    from scipy.spatial import cKDTree

    distances, near = cKDTree(gaussians.means).query(points, k=min(NEIGHBOURS, len(gaussians.means)))
    width = np.maximum(distances[:, distances.shape[1] // 2, None], 1e-6)
    facing = np.einsum("pc,pkc->pk", normals, gaussians.normals[near].astype(np.float64))
    shares = np.exp(-2 * (distances / width) ** 2) * np.clip((facing - FACING) / (1 - FACING), 1e-4, 1)
    shares *= gaussians.opacities[near]
    return Binding(near, shares / shares.sum(axis=1, keepdims=True))


def vertex_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Area-weighted unit normals [V, 3]; Y where a vertex has no face."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crosses)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Floats = np.where(lengths > 0, normals / np.where(lengths > 0, lengths, 1), [0.0, 1.0, 0.0])
    return unit


def outline_distances(points: Floats, normals: Floats, gaussians: Gaussians) -> Floats:
    """Distance [P] m from ``points`` [P, 3] along ``normals`` [P, 3] to where the player's outline is.

    There a line of sight that grazes the surface is half opaque. Of all grazing lines that is the one along which the
    surface bends away most: the outline of a limb as seen from its side.
    """
    from scipy.spatial import cKDTree

    _, near = cKDTree(gaussians.means).query(points, k=min(2 * NEIGHBOURS, len(gaussians.means)))
    precisions = inverse_covariances(gaussians)[near]  # [P, K, 3, 3]
    offsets, opacities = points[:, None] - gaussians.means[near], gaussians.opacities[near].astype(np.float64)
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    nearest = np.full(len(points), np.inf)
    for angle in np.arange(SIGHTS) * np.pi / SIGHTS:
        sight = np.cos(angle) * first + np.sin(angle) * second
        along = np.einsum("pkab,pb->pka", precisions, sight)
        length = np.einsum("pka,pa->pk", along, sight)
        low, high = np.zeros(len(points)), np.full(len(points), MAX_LIFT)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            there = offsets + (middle[:, None] * normals)[:, None]
            squared = np.einsum("pka,pkab,pkb->pk", there, precisions, there)
            squared -= np.einsum("pka,pka->pk", along, there) ** 2 / length
            alpha = np.minimum(opacities * np.exp(-0.5 * squared), 0.99)
            opaque = np.log1p(-alpha).sum(axis=1) < np.log(0.5)
            low, high = np.where(opaque, middle, low), np.where(opaque, high, middle)
        nearest = np.minimum(nearest, low)
    return nearest


def inverse_covariances(gaussians: Gaussians) -> Floats:
    """Inverse covariances [N, 3, 3], 1/m²."""
    xx, xy, xz, yy, yz, zz = gaussians.covariances.astype(np.float64).T
    inverse: Floats = np.linalg.inv(np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3))
    return inverse


def _mean_at_rest(poses: Sequence[Gaussians]) -> Gaussians:
    """The first of ``poses`` with means and visibility averaged over all."""
    first = poses[0]
    arrays = {name: getattr(first, name) for name in vars(first)}
    for name in ("means", "visibility"):
        arrays[name] = np.mean([getattr(pose, name) for pose in poses], axis=0, dtype=np.float64).astype(np.float32)
    return Gaussians(**arrays)


def _projected(body: Body, gaussians: Gaussians, spacing: float) -> tuple[Floats, Floats]:
    """Vertices [V, 3] m of the template moved onto ``gaussians``, and their normals [V, 3]."""
    template_normals = vertex_normals(body.vertices, body.faces)
    vertices = body.vertices.copy()
    for _ in range(PROJECTIONS):
        binding = bind(vertices, template_normals, gaussians)
        normals = binding.of(gaussians.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        heights = ((binding.of(gaussians.means) - vertices) * normals).sum(axis=1)
        vertices += heights[:, None] * normals
    lift = outline_distances(vertices, normals, gaussians)
    moved = vertices - body.vertices + lift[:, None] * normals
    for _ in range(SMOOTHING):
        moved = _neighbour_mean(moved, body.faces)
    vertices = body.vertices + moved
    return vertices, vertex_normals(vertices, body.faces)


def _neighbour_mean(values: Floats, faces: NDArray[np.int32]) -> Floats:
    """``values`` [V, 3], half their own and half the mean of their neighbours'."""
    total, count = np.zeros_like(values), np.zeros(len(values))
    for a, b in ((0, 1), (1, 2), (2, 0)):
        for i, j in ((a, b), (b, a)):
            np.add.at(total, faces[:, i], values[faces[:, j]])
            np.add.at(count, faces[:, i], 1)
    mean = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], values)
    return (values + mean) / 2


def _follow(vertices: Floats, binding: Binding, mean: Gaussians, pose: PosedWeights) -> Floats:
    """Vertices [V, 3] m in the root's frame, moved as the Gaussians that they are bound to."""
    moved = vertices + binding.of(pose.at_rest.means - mean.means)
    weights = binding.of(pose.weights)
    return skin(moved, weights / weights.sum(axis=1, keepdims=True), pose.bones)


def _fitted_weights(
    vertices: Floats, binding: Binding, gaussians: Gaussians, poses: Sequence[PosedWeights]
) -> tuple[NDArray[np.float32], float]:
    """Weights [V, J] of four joints per vertex and their mean error over ``poses``, m.

    Least squares over the simplex: Σ_j w_j B_j x against the avatar's own posing.
    """
    own = np.mean([binding.of(pose.weights) for pose in poses], axis=0)
    targets = [_follow(vertices, binding, gaussians, pose) for pose in poses]
    points = np.c_[vertices, np.ones(len(vertices))]
    # The weights sum to 1, so only distances between joints' positions and the target count.
    apart = np.stack(
        [np.einsum("jrc,vc->vjr", pose.bones, points) - target[:, None] for pose, target in zip(poses, targets)], axis=1
    ).astype(np.float32)  # [V, T, J, 3] m
    importance = own * (1e-4 + np.sqrt(np.mean((apart**2).sum(axis=-1), axis=1)))
    used = np.argsort(-importance, axis=1, kind="stable")[:, :JOINTS]  # [V, 4]
    prior = np.take_along_axis(own, used, axis=1)
    prior /= prior.sum(axis=1, keepdims=True)
    apart = np.take_along_axis(apart, used[:, None, :, None], axis=2).astype(np.float64)
    gram = np.einsum("vtir,vtjr->vij", apart, apart) / len(poses) + PRIOR * np.eye(used.shape[1])
    right = PRIOR * prior
    fitted = _on_simplex(gram, right, prior)
    weights = np.zeros_like(own)
    np.put_along_axis(weights, used, fitted, axis=1)
    errors = np.linalg.norm(np.einsum("vj,vtjr->vtr", fitted, apart), axis=-1)
    return weights.astype(np.float32), float(errors.mean())


def _on_simplex(gram: Floats, right: Floats, start: Floats, steps: int = 300) -> Floats:
    """Minimisers [V, K] of ½ wᵀ G w − w·right with w ≥ 0 and Σ w = 1, by accelerated projected gradients."""
    step = 1 / np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-12)[:, None]
    now, ahead, momentum = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        gradient = np.einsum("vij,vj->vi", gram, ahead) - right
        following = _simplex_projection(ahead - step * gradient)
        next_momentum = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = following + (momentum - 1) / next_momentum * (following - now)
        now, momentum = following, next_momentum
    return now


def _simplex_projection(points: Floats) -> Floats:
    """The nearest point of the simplex to each of [V, K]. Source: Duchi et al. 2008."""
    ordered = -np.sort(-points, axis=1)
    excess = (np.cumsum(ordered, axis=1) - 1) / np.arange(1, points.shape[1] + 1)
    last = (ordered > excess).sum(axis=1) - 1
    return np.maximum(points - excess[np.arange(len(points)), last][:, None], 0)
