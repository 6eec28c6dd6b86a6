"""Balls of Gaussians and light probes."""

from __future__ import annotations

import numpy as np

from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.light import Light, texel_directions
from rnd_runtime.shading.sh import SH_COUNT, sh_basis, sphere_quadrature

COUNT = 1500


def fibonacci_sphere(count):
    i = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], -1)


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def ball(count=COUNT, seed=0, roughness=(0.35, 0.99), open_sky=False):
    """A unit ball of Gaussians; visibility is a random smooth mask of some half of the sphere, or one."""
    rng = np.random.default_rng(seed)
    normals = fibonacci_sphere(count)
    visibility = np.zeros((count, SH_COUNT))
    visibility[:, 0] = np.sqrt(4 * np.pi)
    root = rotation(seed + 1)
    if not open_sky:
        directions, weights = sphere_quadrature(12)
        tilted = normals + 0.8 * np.sin(3 * normals @ rng.normal(size=(3, 3)))
        facing = 1 / (1 + np.exp(-4 * (tilted @ root @ directions.T)))  # in the root's frame
        visibility = facing @ (sh_basis(directions) * weights[:, None])
    spacing = np.sqrt(4 * np.pi / max(count, 1))
    covariances = np.zeros((count, 6))
    covariances[:, [0, 3, 5]] = (0.6 * spacing) ** 2
    albedo = rng.uniform(0.03, 0.8, (count, 3))
    albedo[::4] *= 0.03  # darker than F0
    arrays = (
        normals,
        covariances,
        np.full(count, 0.95),
        normals,
        albedo,
        rng.uniform(*roughness, count),
        visibility,
        root,
    )
    return Gaussians(*(np.asarray(a, np.float32) for a in arrays))


def probe(height=32, sun=0.0, yaw=0.0, up="y"):
    """A coloured sky with a bright window, and a texel of sun when asked for."""
    directions = texel_directions(height, 2 * height)
    window = np.exp(8 * (directions @ [0.6, 0.48, 0.64] - 1))[..., None]
    radiance = np.array([0.3, 0.5, 0.9]) * (1.2 + directions[..., 1:2]) + window * np.array([6.0, 5, 3])
    radiance[..., 0] *= 1 + 0.5 * np.sin(4 * directions[..., 0])
    radiance[height // 4, height // 3] += sun * np.array([1, 0.9, 0.7])
    return Light(radiance.astype(np.float32), yaw=yaw, up=up)
