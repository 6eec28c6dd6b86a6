"""Shadows that a body casts on the ground, as the share of the ground's irradiance that is left.

On a plane a shadow is an oblique projection: the body, as spheres, is projected along directions of the light. The sky
is sampled in ``SKY_DIRECTIONS`` of equal cosine-weighted solid angle, each with the blur of its cell; every directional
light has a finer grid and the blur of its spread. Nothing is occluded twice, so energy is right for any light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, shallow_copy
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.directional import extract_directional
from rnd_runtime.shading.light import Light

from .kernels import look_up, project

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

SKY_DIRECTIONS = 64
"""of the sky's shadow"""
SKY_CELL, SKY_REACH = 0.05, 3.0
"""m, cell and half side of the sky's grid around the body"""
SUN_CELLS, SUN_CELL, SUN_REACH = 384, 0.006, 8.0
"""most cells along a side of a directional light's grid, their least size m, and the grid's largest side m"""
NEAR_GROUND = 0.25
"""m, height below which the sky's shadow is sharp and needs small spheres"""
LOW_SPHERES, HIGH_SPHERES, SUN_SPHERES = 512, 640, 8192
"""largest numbers that stand for the body: near the ground and above it for the sky, and for a directional light"""
BANDS = (0.12, 0.3, 0.6, 1.0, 1.5)
"""m, heights between which spheres are blurred alike"""
GROWN, LARGEST = 1.2, 0.045
"""factor on the discs' radii that closes the gaps of a thinned body; their bound, m, about that of a forearm"""
MIN_ELEVATION = math.radians(3)
"""below which a directional light casts no shadow on the ground: it would be longer than 30 m"""
SINK = 0.8
"""of a sphere's radius, by which its centre lies below the surface"""


class Plane(NamedTuple):
    """Points x with normal · x = offset."""

    normal: Floats  # [3] unit, away from the ground
    offset: float  # m

    def in_frame(self, frame_to_world: Floats) -> Plane:
        """The same plane in a frame; ``frame_to_world`` [4, 4] is rigid."""
        normal = frame_to_world[:3, :3].T @ self.normal
        return Plane(normal, float(self.offset - self.normal @ frame_to_world[:3, 3]))


@dataclass(frozen=True, eq=False)
class Grid:
    """Values on a part of the ground: cell (i, j) lies at origin + (i + ½) · along + (j + ½) · across."""

    values: Floats32  # [I, J, C], blocked share
    origin: Floats  # [3] m
    along: Floats  # [3] m, a cell
    across: Floats  # [3] m, a cell


class GroundLight:
    """A light's irradiance on the ground, split into sky directions and directional lights.

    Args:
        light: the probe; ``with_yaw`` changes its yaw at little cost.
        normal: [3] unit, of the ground in the world.
    """

    def __init__(self, light: Light, normal: ArrayLike = (0.0, 1.0, 0.0)) -> None:
        normal = np.asarray(normal, np.float64)
        self.light, self._normal = light, normal
        sky, self._suns_of_probe = extract_directional(light)
        self._sky_of_probe = sky.resized(16, 32)
        count = np.arange(SKY_DIRECTIONS) + 0.5
        radius, azimuth = np.sqrt(count / SKY_DIRECTIONS), count * math.pi * (3 - math.sqrt(5))  # Malley's method
        tangent, bitangent = _tangents(normal)
        self.directions: Floats = (
            (radius * np.cos(azimuth))[:, None] * tangent
            + (radius * np.sin(azimuth))[:, None] * bitangent
            + np.sqrt(1 - radius**2)[:, None] * normal
        )
        self._light_up(light)

    def with_yaw(self, light: Light) -> GroundLight:
        """The same for ``light``, which differs by its yaw alone."""
        turned = shallow_copy(self, light=light)
        turned._light_up(light)
        return turned

    def _light_up(self, light: Light) -> None:
        sky = self._sky_of_probe.with_yaw(light.yaw).sample(self.directions)
        self.sky: Floats = sky.astype(np.float64) * math.pi / SKY_DIRECTIONS
        self.suns: list[tuple[Floats, Floats, float]] = []  # direction, irradiance on the ground, spread
        for sun in self._suns_of_probe:
            direction = light.rotation @ sun.direction
            cosine = float(direction @ self._normal)
            if cosine > math.sin(MIN_ELEVATION):
                self.suns.append((direction, sun.irradiance * cosine, sun.spread))
        self.irradiance: Floats = self.sky.sum(0) + sum((e for _, e, _ in self.suns), np.zeros(3))

    def shadow(self, gaussians: Gaussians, radii: Floats32, plane: Plane, frame_to_world: Floats) -> list[Grid]:
        """Blocked shares of the irradiance: grids that add up.

        Args:
            gaussians: in a frame of their own.
            radii: [N] m of discs around them, 0 for those that cast no shadow.
            plane: in that frame.
            frame_to_world: [3, 3].
        """
        if not self.irradiance.max() > 0 or not radii.any():
            return []
        grids = []
        total = np.maximum(self.irradiance, 1e-12 * self.irradiance.max())
        low = gaussians.means @ plane.normal.astype(np.float32) < plane.offset + NEAR_GROUND
        strata = _spheres(gaussians, radii, LOW_SPHERES, low), _spheres(gaussians, radii, HIGH_SPHERES, ~low)
        few = _sorted(Spheres(*(np.concatenate(parts) for parts in zip(*strata))), plane)
        directions = floats(self.directions @ frame_to_world)
        grid = _grid_below(few, plane)
        blur = math.sqrt(1 / SKY_DIRECTIONS)  # radius of a cell of the hemisphere, seen from the ground
        shares = floats(self.sky / total)
        project(*few, *_frame(grid, plane), directions, shares, np.float32(blur), _bands(few, plane), grid.values)
        grids.append(grid)
        if self.suns:
            many = _sorted(_spheres(gaussians, radii, SUN_SPHERES), plane)
            for direction, irradiance, angle in self.suns:
                towards = direction @ frame_to_world
                grid = _grid_towards(many, plane, towards)
                share = floats((irradiance / total)[None])
                along_sun, penumbra = floats(towards[None]), np.float32(math.tan(angle))
                project(*many, *_frame(grid, plane), along_sun, share, penumbra, _bands(many, plane), grid.values)
                grids.append(grid)
        return grids


def remaining_light(grids: list[Grid], plane: Plane, camera: Camera) -> Floats32:
    """Share [H, W, 3] of the ground's irradiance at every pixel that sees the ground; 1 elsewhere."""
    rays = camera.rays
    remaining = np.ones((camera.height, camera.width, 3), np.float32)
    for grid in grids:
        inverse = np.linalg.pinv(np.stack([grid.along, grid.across], axis=1))  # [2, 3], cells of a metre
        look_up(
            rays,
            camera.position,
            plane.normal,
            plane.offset,
            inverse,
            inverse @ grid.origin + 0.5,
            grid.values,
            remaining,
        )
    return np.maximum(remaining, 0, out=remaining)


class Spheres(NamedTuple):
    """Spheres that stand for the body, from low to high."""

    centres: Floats32  # [n, 3] m
    radii: Floats32  # [n] m


def _spheres(gaussians: Gaussians, radii: Floats32, count: int, among: NDArray[np.bool_] | bool = True) -> Spheres:
    """At most ``count`` spheres of the same surface ``among`` [N] the Gaussians."""
    casting = np.nonzero((radii > 0) & among)[0]
    step = max(1, math.ceil(len(casting) / count))
    chosen = casting[::step]
    size = np.minimum(radii[chosen] * np.float32(GROWN * math.sqrt(step)), np.float32(LARGEST))
    centres = gaussians.means[chosen] - np.float32(SINK) * size[:, None] * gaussians.normals[chosen]
    return Spheres(floats(centres), floats(size))


def _sorted(spheres: Spheres, plane: Plane) -> Spheres:
    order = np.argsort(spheres.centres @ plane.normal.astype(np.float32), kind="stable")
    return Spheres(spheres.centres[order], spheres.radii[order])


def _bands(spheres: Spheres, plane: Plane) -> NDArray[np.int64]:
    """First sphere of each band of heights, and the number of spheres."""
    heights = spheres.centres.astype(np.float64) @ plane.normal - plane.offset
    return np.concatenate([[0], np.searchsorted(heights, BANDS), [len(heights)]]).astype(np.int64)


def _tangents(normal: Floats) -> tuple[Floats, Floats]:
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    tangent = np.cross(axis, normal)
    tangent /= np.linalg.norm(tangent)
    return tangent, np.cross(normal, tangent)


def _grid_below(spheres: Spheres, plane: Plane) -> Grid:
    """The sky's grid around the body's foot."""
    tangent, bitangent = _tangents(plane.normal)
    centre = spheres.centres.mean(axis=0, dtype=np.float64)
    centre = centre - (plane.normal @ centre - plane.offset) * plane.normal
    cells = round(2 * SKY_REACH / SKY_CELL)
    origin = centre - SKY_REACH * (tangent + bitangent)
    return Grid(np.zeros((cells, cells, 3), np.float32), origin, SKY_CELL * tangent, SKY_CELL * bitangent)


def _grid_towards(spheres: Spheres, plane: Plane, towards: Floats) -> Grid:
    """A grid around the shadow along one direction, its sides along and across the direction's azimuth."""
    sine = float(towards @ plane.normal)
    along = towards - sine * plane.normal
    length = np.linalg.norm(along)
    along = along / length if length > 1e-6 else _tangents(plane.normal)[0]
    across = np.cross(plane.normal, along)
    height = np.maximum(spheres.centres @ plane.normal - plane.offset, 0)
    hits = spheres.centres - height[:, None] / sine * towards
    places = hits @ np.stack([along, across], axis=1)  # [n, 2] m
    margin = float(spheres.radii.max()) * np.array([1 / sine, 1.0]) + 0.03
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    low[0] = max(low[0], float(places[:, 0].max()) - SUN_REACH)  # the feet's end of a long shadow is kept
    cell = np.maximum((high - low) / SUN_CELLS, SUN_CELL)
    cells = np.ceil((high - low) / cell).astype(int)
    origin = low[0] * along + low[1] * across + plane.offset * plane.normal
    return Grid(np.zeros((*cells, 3), np.float32), origin, cell[0] * along, cell[1] * across)


def _frame(grid: Grid, plane: Plane) -> tuple[Floats32, Floats32, np.float32, Floats32, Floats32]:
    """Normal, origin, offset and the cells' vectors, as the kernel takes them."""
    along, across = (v / (v @ v) for v in (grid.along, grid.across))
    return floats(plane.normal), floats(grid.origin), np.float32(plane.offset), floats(along), floats(across)
