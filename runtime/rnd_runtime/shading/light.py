"""Light probes: lat-long maps of linear radiance, and resampling that conserves their energy."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import shallow_copy
from rnd_runtime.core.errors import InputError

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Up = Literal["y", "z", "-y"]

_DIM = 1e-3  # largest radiance below which every 8-bit pixel of a body would be black or next to it

_TO_Y_UP: dict[str, Floats] = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # (x, y, z) → (x, z, −y)
    "-y": np.diag([1.0, -1.0, -1.0]),  # OpenCV camera axes
}


@dataclass(frozen=True, eq=False)
class Light:
    """Distant light all around, as a lat-long map.

    Column and row of a direction (x, y, z) **in the light's frame**: ``u = 0.5 + atan2(z, x) / 2π``,
    ``v = acos(y) / π``; texel centres at (i + 0.5) / N. Only ``rotation`` relates that frame to the
    world, so rotating a light never changes its texels.

    Attributes:
        radiance: [H, W, 3] linear Rec.709, finite and not negative, W = 2 H.
        yaw: rotation of the light about +Y, radians: what the map has at azimuth φ = atan2(z, x) appears at
            φ + yaw, so it moves from +X towards +Z.
        up: which axis of the map's frame points up in the world it was made for.
        repaired: texels that were filled in when it was read.
        notes: for the user, one sentence each.
    """

    radiance: Floats32
    yaw: float = 0.0
    up: Up = "y"
    repaired: int = 0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        radiance = np.ascontiguousarray(self.radiance, np.float32)
        if radiance.ndim != 3 or radiance.shape[2] != 3 or radiance.shape[1] != 2 * radiance.shape[0]:
            raise InputError("light", expected="[H, 2H, 3]", got=list(radiance.shape))
        if not np.isfinite(radiance).all() or radiance.min() < 0:
            raise InputError("light", expected="finite radiance, not negative")
        _check_yaw(self.yaw)
        if self.up not in _TO_Y_UP:
            raise InputError("light up", expected=" or ".join(_TO_Y_UP), got=self.up)
        object.__setattr__(self, "radiance", radiance)

    @cached_property
    def rotation(self) -> Floats:
        """[3, 3], light's frame → world."""
        return _rotation(self.yaw, self.up)

    @property
    def maximum(self) -> float:
        """The largest radiance of any channel."""
        return float(self.radiance.max())

    @property
    def mean_radiance(self) -> Floats:
        """[3], the radiance averaged over the sphere; π times it is the irradiance averaged over normals."""
        height, width = self.radiance.shape[:2]
        weights = texel_solid_angles(height, width) / (4 * np.pi)
        return np.asarray(np.einsum("hwc,hw->c", self.radiance.astype(np.float64), weights))

    def with_yaw(self, yaw: float) -> Light:
        """The same light at another ``yaw``; shares the texels."""
        _check_yaw(yaw)
        return shallow_copy(self, yaw=yaw, rotation=_rotation(yaw, self.up))

    def resized(self, height: int, width: int) -> Light:
        """The same light on another grid, by ``downsize``."""
        return replace(self, radiance=downsize(self.radiance, height, width))

    def scaled(self, scale: ArrayLike) -> Light:
        """The same light times ``scale``, a number or one per channel."""
        return replace(self, radiance=finite_float32(self.radiance * np.asarray(scale, np.float64)))

    def sample(self, directions: ArrayLike) -> Floats32:
        """Radiance [..., 3] seen towards world ``directions`` [..., 3], of any length but zero.

        Bilinear between texel centres; wraps around horizontally, clamps at the poles.
        """
        from rnd_runtime.core.latlong import sample_latlong  # compiled: options name this module before there is a need

        local = np.asarray(directions, np.float64) @ self.rotation  # Rᵀ d
        sampled = np.empty((local.size // 3, 3), np.float32)
        sample_latlong(self.radiance, np.ascontiguousarray(local.reshape(-1, 3)), sampled)
        return sampled.reshape(local.shape)


def _rotation(yaw: float, up: Up) -> Floats:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    rotation: Floats = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return rotation if up == "y" else rotation @ _TO_Y_UP[up]


def _check_yaw(yaw: float) -> None:
    if not math.isfinite(yaw):
        raise InputError("light yaw", expected="finite radians", got=yaw)


def light_notes(light: Light) -> list[str]:
    """Notes on ``light`` for the user, one sentence each."""
    notes = list(light.notes)
    if light.repaired:
        notes.append(f"{light.repaired} texels of the light were NaN, infinite or negative and were filled in")
    if light.maximum < _DIM:
        notes.append(f"the light is dark: its largest radiance is {light.maximum:.3g}; try --exposure")
    return notes


_COARSE = 32, 64  # texels in which bright parts are told apart


def brightest_direction(light: Light) -> Floats:
    """Unit vector [3] towards the mean of a light's bright parts, in the world: weighted by squared luminance."""
    luminance = downsize(light.radiance, *_COARSE).astype(np.float64) @ REC709_LUMINANCE
    weights = (luminance / max(luminance.max(), 1e-30)) ** 2 * texel_solid_angles(*_COARSE)
    mean = light.rotation @ np.einsum("hw,hwc->c", weights, texel_directions(*_COARSE))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-30))


def texel_directions(height: int, width: int) -> Floats:
    """[H, W, 3], the unit direction of every texel's centre in the light's frame."""
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    polar = ((np.arange(height) + 0.5) / height * np.pi)[:, None]
    ring = np.sin(polar)
    return np.stack(
        [ring * np.cos(azimuth), np.broadcast_to(np.cos(polar), (height, width)), ring * np.sin(azimuth)], -1
    )


def texel_solid_angles(height: int, width: int) -> Floats:
    """[H, W] sr, exact: a row between polar angles a and b covers 2π (cos a − cos b). The sum is 4π."""
    rows = -np.diff(row_edges(height)) * 2 * np.pi / width
    return np.broadcast_to(rows[:, None], (height, width)).copy()


REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""luminance of linear R, G and B (ITU-R BT.709-6, section 3)"""


def downsize(radiance: ArrayLike, height: int, width: int) -> Floats32:
    """``radiance`` [H, W, C] as the mean over each of ``height`` × ``width`` texels, weighted by solid angle.

    Exact for any two sizes, so Σ radiance · solid angle stays; bilinear resizing would lose a
    small sun. Larger grids repeat texels.
    """
    source = np.asarray(radiance, np.float64)
    # solid angle is uniform in azimuth and in y = cos(polar angle): both axes are one-dimensional overlaps
    vertical = overlaps(1 - row_edges(source.shape[0]), 1 - row_edges(height))
    horizontal = overlaps(np.arange(source.shape[1] + 1) / source.shape[1], np.arange(width + 1) / width)
    rows = np.tensordot(vertical, source, (1, 0))
    return np.ascontiguousarray(np.tensordot(horizontal, rows, (1, 1)).swapaxes(0, 1), np.float32)


def row_edges(rows: int) -> Floats:
    """y = cos(polar angle) [rows + 1] of the edges between rows, from 1 down to −1."""
    return np.cos(np.linspace(0, np.pi, rows + 1))


def overlaps(source: Floats, target: Floats) -> Floats:
    """[targets, sources], the fraction of each target interval each source interval covers; edges given."""
    low = np.maximum(target[:-1, None], source[None, :-1])
    high = np.minimum(target[1:, None], source[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / np.diff(target)[:, None])


def finite_float32(radiance: NDArray[np.floating]) -> Floats32:
    """To float32, clipped to its range."""
    return np.asarray(np.clip(radiance, 0, np.finfo(np.float32).max), np.float32)
