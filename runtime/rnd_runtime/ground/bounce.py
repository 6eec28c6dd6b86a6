"""Light that the ground reflects onto the body: one diffuse bounce.

A body on a wide plane sees the plane below the horizon, of one radiance but for the body's shadow. The light probe's
lower half becomes that radiance, so every shading mode has it and no frame takes longer; of the shadow, the mean over
what the body sees of the ground is taken off.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.motion import Motion
from rnd_runtime.shading.light import Light, texel_directions, texel_solid_angles
from rnd_runtime.shading.sh import sh_basis
from rnd_runtime.shading.shader import shadow_radii

from .shadow import GroundLight, Plane, Shadow

Floats = NDArray[np.float64]

FRAMES = 6
"""evenly spaced, over which the shadow is averaged"""
POINTS, DIRECTIONS = 400, 32
"""on the body, and from each"""


def light_over(light: Light, normal: ArrayLike, reflected: ArrayLike) -> Light:
    """``light`` with the ground's radiance below the horizon.

    Args:
        normal: [3] unit, of the ground in the world, along the axis about which the light is turned.
        reflected: [3] share of the ground's irradiance.
    """
    height, width = light.radiance.shape[:2]
    cosines = texel_directions(height, width) @ (light.rotation.T @ np.asarray(normal, np.float64))
    flux = light.radiance * texel_solid_angles(height, width)[..., None]
    irradiance = np.einsum("hwc,hw->c", flux, np.maximum(cosines, 0))
    below = np.clip(0.5 - cosines * height / math.pi, 0, 1)[..., None]  # a texel at the horizon is mixed
    radiance = (1 - below) * light.radiance + below * irradiance * np.asarray(reflected, np.float64) / math.pi
    return replace(light, radiance=radiance.astype(np.float32))


def mean_share(gaussians: Gaussians, shadow: Shadow | None) -> Floats:
    """Mean share [3] of the ground's light that a body's shadow leaves, where the body sees the ground.

    Args:
        gaussians: in the frame of ``shadow``.
    """
    if shadow is None:
        return np.ones(3)
    some = gaussians.only(np.arange(0, len(gaussians.means), len(gaussians.means) // POINTS + 1))
    points, normals = some.means.astype(np.float64), some.normals.astype(np.float64)
    count = np.arange(DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * count / DIRECTIONS, count * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - z * z)
    sphere = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    rise = sphere @ shadow.plane.normal
    sphere, fall = sphere[rise < -0.05], -rise[rise < -0.05]
    seen = np.maximum(normals @ sphere.T, 0) * np.clip(
        some.visibility @ sh_basis(sphere @ gaussians.root_rotation).T, 0, 1
    )
    heights = np.maximum(points @ shadow.plane.normal - shadow.plane.offset, 0)
    met = points[:, None] + (heights[:, None] / fall)[..., None] * sphere
    left = shadow.share_at(met @ shadow.plane.axes[:2].T)
    total = float(seen.sum())
    return np.array(np.einsum("nd,ndc->c", seen, left) / total, np.float64) if total > 0 else np.ones(3)


def reflected_share(avatar: Avatar, motion: Motion, light: Light, plane: Plane, albedo: ArrayLike) -> Floats:
    """Share [3] of the ground's irradiance that ``light_over`` takes: ``albedo`` [3] times the mean over ``motion``."""
    ground = GroundLight(light, plane.normal)
    shares = []
    for time in np.linspace(0, motion.duration, FRAMES):
        encoded = avatar.encode(motion, float(time))
        gaussians = avatar.posed(encoded)
        here = plane.in_frame(encoded.root)
        shadow = ground.shadow(gaussians, shadow_radii(gaussians), here, encoded.root[:3, :3])
        shares.append(mean_share(gaussians, shadow))
    return np.array(np.asarray(albedo, np.float64) * np.mean(shares, axis=0), np.float64)
