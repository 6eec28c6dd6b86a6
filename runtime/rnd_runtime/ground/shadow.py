"""Shadows that a body casts on the ground, as the share of the ground's irradiance that is left.

On a plane a shadow is an oblique projection of the body. The sky is sampled in ``SKY_DIRECTIONS`` of equal
cosine-weighted solid angle, summed into one map; every directional light has a finer map and the blur of its spread.
Nothing is occluded twice, so energy is right for any light.
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
from rnd_runtime.raster.oracle import NEAR
from rnd_runtime.shading.directional import extract_directional
from rnd_runtime.shading.light import Light

from . import sky
from .lookup import GROUP, sky_light, subtract_sun
from .stand_in import StandIn, stand_in
from .sun import bounds, sun_map

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

SKY_DIRECTIONS = 128
"""of the sky's shadow"""
SUN_CELLS, SUN_CELL, SUN_REACH = 512, (0.006, 0.05), 8.0
"""most cells along a side of a directional light's map, bounds of their size m, and the map's largest side m"""
MIN_ELEVATION = math.radians(3)
"""below which a directional light casts no shadow on the ground: it would be longer than 30 m"""
BOX = math.sqrt(1.5)
"""half width of a box over the root mean square radius of a disc of the same variance along either axis"""
MAX_STEP = 15
"""pixels between look-ups of the sky's map"""


class Plane(NamedTuple):
    """Points x with normal · x = offset."""

    normal: Floats  # [3] unit, away from the ground
    offset: float  # m

    def in_frame(self, frame_to_world: Floats) -> Plane:
        """The same plane in a frame; ``frame_to_world`` [4, 4] is rigid."""
        normal = frame_to_world[:3, :3].T @ self.normal
        return Plane(normal, float(self.offset - self.normal @ frame_to_world[:3, 3]))

    @property
    def axes(self) -> Floats:
        """[3, 3] by rows: two unit vectors in the plane, and the normal."""
        x, y, z = self.normal.tolist()
        if abs(x) <= min(abs(y), abs(z)):
            a, b, c = 0.0, -z, y  # across X and the normal
        elif abs(y) <= abs(z):
            a, b, c = z, 0.0, -x
        else:
            a, b, c = -y, x, 0.0
        length = math.sqrt(a * a + b * b + c * c)
        a, b, c = a / length, b / length, c / length
        return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a], [x, y, z]])


class Map(NamedTuple):
    """Blocked shares on a part of the plane."""

    values: Floats32  # [I, J, 4] RGB and 0; [I, J] of one light
    to_cells: Floats  # [2, 3], (x, y, 1) in the plane's axes, m → row and column, cell centres at integers


@dataclass(frozen=True, eq=False)
class Shadow:
    """A body's shadow on a plane.

    Attributes:
        sky: shares of the irradiance.
        suns: shares of each sun's light, and its own share [3] of the irradiance.
        pixel: m, the finest detail that is wanted.
    """

    plane: Plane
    sky: Map
    suns: tuple[tuple[Map, Floats32], ...]
    pixel: float

    def remaining(self, camera: Camera, image: Floats32) -> Floats32:
        """Fill ``image`` [H, W, 3] with the share of the ground's irradiance at pixels that see the ground, else 1."""
        to_plane = image_to_plane(camera, self.plane)
        step = int(min(float(sky.CELL) / self.pixel / 2, MAX_STEP)) // GROUP * GROUP or 1
        sky_light(compose(self.sky.to_cells, to_plane), self.sky.values, step, image)
        for sun, share in self.suns:
            subtract_sun(compose(sun.to_cells, to_plane), sun.values, share, image)
        return image

    def region(self, camera: Camera) -> tuple[slice, slice]:
        """Rows and columns of the image that may see the shadow; all where a part of it is not in front of the eye."""
        corners = np.concatenate([_corners(map_, self.plane) for map_ in (self.sky, *(sun for sun, _ in self.suns))])
        pixels, depths = camera.project(corners)
        if depths.min() < NEAR:
            return slice(0, camera.height), slice(0, camera.width)
        left, top, right, bottom = camera.box(pixels)
        return slice(top, bottom), slice(left, right)

    def share_at(self, points: Floats) -> Floats:
        """Share [..., 3] of the irradiance at ``points`` [..., 2] m of the plane, in its axes; of the nearest cells."""
        left = 1 - _nearest(self.sky, points)[..., :3].astype(np.float64)
        for sun, share in self.suns:
            left -= _nearest(sun, points)[..., None] * share
        return np.maximum(left, 0)


class GroundLight:
    """A light's irradiance on the ground, split into sky directions and directional lights.

    Args:
        light: the probe; ``with_yaw`` changes its yaw at little cost.
        normal: [3] unit, of the ground in the world.
    """

    def __init__(self, light: Light, normal: ArrayLike = (0.0, 1.0, 0.0)) -> None:
        axes = Plane(np.asarray(normal, np.float64), 0.0).axes
        self.light, self._normal = light, axes[2]
        rest, self._suns_of_probe = extract_directional(light)
        self._sky_of_probe = rest.resized(16, 32)
        count = np.arange(SKY_DIRECTIONS) + 0.5
        radius, azimuth = np.sqrt(count / SKY_DIRECTIONS), count * math.pi * (3 - math.sqrt(5))  # Malley's method
        height = np.sqrt(1 - radius**2)
        self.directions: Floats = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1) @ axes
        self._light_up(light)

    def with_yaw(self, light: Light) -> GroundLight:
        """The same for ``light``, which differs by its yaw alone."""
        turned = shallow_copy(self, light=light)
        turned._light_up(light)
        return turned

    def _light_up(self, light: Light) -> None:
        radiance = self._sky_of_probe.with_yaw(light.yaw).sample(self.directions)
        self.sky: Floats = radiance.astype(np.float64) * math.pi / SKY_DIRECTIONS
        self.suns: list[tuple[Floats, Floats, float]] = []  # direction, irradiance on the ground, spread
        for sun in self._suns_of_probe:
            direction = light.rotation @ sun.direction
            cosine = float(direction @ self._normal)
            if cosine > math.sin(MIN_ELEVATION):
                self.suns.append((direction, sun.irradiance * cosine, sun.spread))
        self.irradiance: Floats = self.sky.sum(0) + sum((e for _, e, _ in self.suns), np.zeros(3))

    def shadow(
        self, gaussians: Gaussians, radii: Floats32, plane: Plane, frame_to_world: Floats, *, pixel: float = 0.005
    ) -> Shadow | None:
        """The shadow of a body; None where there is no light or no body.

        Args:
            gaussians: in a frame of their own.
            radii: [N] m of discs around them, 0 for those that cast no shadow.
            plane: in that frame.
            frame_to_world: [3, 3].
            pixel: m, finest detail that is wanted, see ``footprint``.
        """
        if not self.irradiance.max() > 0:
            return None
        axes = plane.axes
        body = stand_in(gaussians, radii, axes, plane.offset)
        if not len(body.discs):
            return None
        total = np.maximum(self.irradiance, 1e-12 * self.irradiance.max())
        to_axes = frame_to_world @ axes.T
        centre = body.discs[:, :2].mean(axis=0)
        values = sky.sky_map(body.discs, centre, floats(self.directions @ to_axes), floats(self.sky / total))
        corner = centre.astype(np.float64) - sky.REACH
        below = Map(values, _to_cells(np.eye(2), corner, np.full(2, sky.CELL, np.float64)))
        suns = []
        for direction, irradiance, spread in self.suns:
            cast = _cast(body, direction @ to_axes, spread, pixel)
            suns.append((cast, floats(irradiance / total)))
        return Shadow(plane, below, tuple(suns), pixel)


def _cast(body: StandIn, towards: Floats, spread: float, pixel: float) -> Map:
    """The map of a directional light; ``towards`` [3] is in the plane's axes."""
    rise, flat = float(towards[2]), math.hypot(towards[0], towards[1])
    cosine, sine = (towards[0] / flat, towards[1] / flat) if flat > 1e-6 else (1.0, 0.0)
    turned = tuple(np.float32(value) for value in (cosine, sine, rise, flat / rise))
    low_u, high_u, low_v, high_v, radius, height = bounds(body.discs, turned[0], turned[1], turned[3])
    blur = BOX * math.tan(spread)
    margin = (float(radius) + blur * float(height) / rise) * np.array([1 / rise, 1.0]) + 0.03
    low, high = np.array([low_u, low_v]) - margin, np.array([high_u, high_v]) + margin
    low = np.maximum(low, high - SUN_REACH)  # the feet's end of a long shadow is kept
    cell = np.maximum((high - low) / SUN_CELLS, min(max(pixel, SUN_CELL[0]), SUN_CELL[1]))
    columns, rows = (int(n) for n in np.ceil((high - low) / cell))
    values = sun_map(*body, turned, (*floats(low),), (*floats(cell),), (rows, columns), np.float32(blur))
    axes = np.array([[-sine, cosine], [cosine, sine]])
    return Map(values, _to_cells(axes, low[::-1], cell[::-1]))


def remaining_light(shadow: Shadow | None, camera: Camera, image: Floats32 | None = None) -> Floats32:
    """Share [H, W, 3] of the ground's irradiance at every pixel, in ``image`` if given; 1 without a shadow."""
    if image is None:
        image = np.empty((camera.height, camera.width, 3), np.float32)
    if shadow is None:
        image.fill(1)
        return image
    return shadow.remaining(camera, image)


def footprint(camera: Camera, plane: Plane, at: Floats) -> float:
    """Metres that a pixel spans at the point of ``plane`` at [2] m in its axes."""
    axes = plane.axes
    point = at @ axes[:2] + plane.offset * plane.normal
    depth = float((camera.world_to_camera @ [*point, 1.0])[2])
    return max(depth, 0.1) / float(camera.K[1, 1])


def _corners(map_: Map, plane: Plane) -> Floats:
    """Corners [4, 3] m of a map, half a cell beyond the centres of its outermost cells."""
    rows, columns = map_.values.shape[:2]
    cells = np.array([[i, j] for i in (-0.5, rows - 0.5) for j in (-0.5, columns - 0.5)])
    on_plane = (cells - map_.to_cells[:, 2]) @ np.linalg.inv(map_.to_cells[:, :2]).T
    return np.asarray(on_plane @ plane.axes[:2] + plane.offset * plane.normal, np.float64)


def _nearest(map_: Map, points: Floats) -> Floats32:
    """Values of the cells at ``points`` [..., 2], 0 outside of the map."""
    cells = np.rint(points @ map_.to_cells[:, :2].T + map_.to_cells[:, 2])
    inside = np.asarray(((cells >= 0) & (cells < map_.values.shape[:2])).all(-1))
    i, j = np.moveaxis(np.where(inside[..., None], cells, 0).astype(int), -1, 0)
    found: Floats32 = map_.values[i, j]
    found[~inside] = 0
    return found


def _to_cells(axes: Floats, low: Floats, cell: Floats) -> Floats:
    """``Map.to_cells``; rows and columns advance along ``axes`` [2, 2] by ``cell`` from ``low`` [2] m."""
    return np.column_stack([axes / cell[:, None], -low / cell - 0.5])


def image_to_plane(camera: Camera, plane: Plane) -> Floats:
    """[3, 3], (column, row, 1) → (x, y, 1) in the plane's axes, m, times a depth, positive where the plane is seen."""
    axes, position = plane.axes, camera.position
    rays = axes @ camera.rays.T  # (column, row, 1) → a direction in the plane's axes
    above = float(plane.normal @ position) - plane.offset
    if above > 0:
        rays[2] *= -1
    else:
        above = -above
    rays[:2] *= above
    rays[:2] += (axes[:2] @ position)[:, None] * rays[2]
    return rays


def compose(to_cells: Floats, to_plane: Floats) -> Floats:
    """``Map.to_cells`` after ``image_to_plane``."""
    return np.concatenate([to_cells @ to_plane, to_plane[2:]])
