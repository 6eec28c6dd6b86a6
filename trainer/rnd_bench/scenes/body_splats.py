"""N Gaussians on a person 1.75 m tall in an A pose, a union of capsules.

They are discs: σ is the points' spacing in the surface's plane (8 mm for 30 000) and a tenth of it along the normal.
Opacities are in 0.7–0.95, features are random colours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# ends [m] and radius [m]; x is mirrored for arms and legs
SPINE = (
    ((0, 1.60, 0.02), (0, 1.64, 0.02), 0.11),
    ((0, 1.42, 0), (0, 1.56, 0.01), 0.055),
    ((-0.09, 1.33, 0), (0.09, 1.33, 0), 0.12),
    ((0, 1.00, 0), (0, 1.35, 0), 0.13),
    ((-0.06, 0.94, 0), (0.06, 0.94, 0), 0.13),
)
LIMBS = (
    ((0.19, 1.39, 0), (0.40, 1.15, 0), 0.05),
    ((0.40, 1.15, 0), (0.57, 0.94, 0.02), 0.04),
    ((0.57, 0.94, 0.02), (0.64, 0.85, 0.03), 0.04),
    ((0.10, 0.90, 0), (0.14, 0.50, 0.01), 0.08),
    ((0.14, 0.50, 0.01), (0.17, 0.10, -0.01), 0.055),
    ((0.17, 0.05, -0.02), (0.19, 0.05, 0.14), 0.05),
)


class Splats(NamedTuple):
    """Inputs of a rasteriser, float32."""

    means: NDArray[np.float32]
    covariances: NDArray[np.float32]
    opacities: NDArray[np.float32]
    features: NDArray[np.float32]


def body_splats(n: int, *, seed: int = 0) -> Splats:
    """N disc-like Gaussians on a union of capsules that stands on y = 0."""
    rng = np.random.default_rng(seed)
    mirror = np.array([-1.0, 1.0, 1.0])
    capsules = [(np.array(a, float), np.array(b, float), radius) for a, b, radius in SPINE + LIMBS]
    capsules += [(np.array(a) * mirror, np.array(b) * mirror, radius) for a, b, radius in LIMBS]
    areas = np.array([2 * np.pi * r * np.linalg.norm(b - a) + 4 * np.pi * r * r for a, b, r in capsules])
    points, normals, tried, found = [], [], 0, 0
    while found < n:
        which = rng.choice(len(capsules), size=n, p=areas / areas.sum())
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        batch, outward = np.empty((n, 3)), np.empty((n, 3))
        for k, (a, b, radius) in enumerate(capsules):
            chosen, length = which == k, float(np.linalg.norm(b - a))
            batch[chosen], outward[chosen] = _on_capsule(a, b, radius, length, direction[chosen], rng)
        outside = np.ones(n, bool)
        for k, (a, b, radius) in enumerate(capsules):
            outside &= (which == k) | (_distance_to_segment(batch, a, b) > radius)
        points.append(batch[outside])
        normals.append(outward[outside])
        tried, found = tried + n, found + int(outside.sum())
    means, normals_all = np.concatenate(points)[:n], np.concatenate(normals)[:n]
    spacing = np.sqrt(areas.sum() * found / tried / n)
    variance, thin = spacing**2, (0.1 * spacing) ** 2
    full = variance * np.eye(3) + (thin - variance) * normals_all[:, :, None] * normals_all[:, None, :]
    upper = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    opacities, features = rng.uniform(0.7, 0.95, n), rng.uniform(0, 1, (n, 3))
    return Splats(*(np.ascontiguousarray(a, np.float32) for a in (means, upper, opacities, features)))


def _on_capsule(
    a: Array, b: Array, radius: float, length: float, direction: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Uniform points on a capsule's surface and their normals, from uniform directions."""
    axis = (b - a) / length
    along = direction @ axis
    on_tube = rng.uniform(size=len(direction)) < length / (length + 2 * radius)
    across = direction - along[:, None] * axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normal = np.where(on_tube[:, None], across, direction)
    position = np.where(on_tube, rng.uniform(size=len(direction)) * length, np.where(along > 0, length, 0.0))
    return a + position[:, None] * axis + radius * normal, normal


def _distance_to_segment(points: Array, a: Array, b: Array) -> Array:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)
