"""Skies with a sun, and what energy it adds."""

from __future__ import annotations

import numpy as np

from rnd_runtime.shading.light import downsize, texel_directions, texel_solid_angles


def sky(height=128, level=(0.3, 0.5, 1.0)):
    """A blue gradient, brighter at the horizon, with a little noise."""
    directions = texel_directions(height, 2 * height)
    gradient = 1.5 - directions[..., 1] ** 2 + 0.3 * directions[..., 0]
    noise = np.random.default_rng(0).uniform(0.9, 1.1, gradient.shape)
    return (gradient * noise)[..., None] * np.array(level)


def direction_of(elevation, azimuth):
    return np.array([np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)])


def with_sun(radiance, direction, peak, radius=0.8):
    """Adds a disc, anti-aliased by averaging down from a grid of twice the size; returns the energy it adds."""
    height = len(radiance)
    cosine = texel_directions(2 * height, 4 * height) @ direction
    disc = np.where(cosine > np.cos(np.radians(radius)), peak, 0.0)[..., None] * np.array([1.0, 0.9, 0.7])
    disc = downsize(disc, height, 2 * height).astype(float)
    return radiance + disc, energy(disc)


def energy(radiance):
    return np.einsum("hwc,hw->c", radiance.astype(np.float64), texel_solid_angles(*radiance.shape[:2]))


def beside_a_lamp():
    """A sun, what it adds, and a lamp of a tenth of its energy whose texels are brighter."""
    radiance, sun_energy = with_sun(sky(256), direction_of(0.7, 1.0), 400, radius=3)
    return with_sun(radiance, direction_of(0.2, -2.0), 600, radius=0.8)[0], sun_energy
