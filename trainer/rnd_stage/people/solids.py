"""Signed distances (metres, negative inside) of smoothly blended solids, mirrored at x = 0.

Solids are rounded cones, ellipsoids, and *lofts*: tubes whose cross-section is a superellipse given by a table along
the axis. Distances are exact to first order at the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import zoom
from skimage.measure import marching_cubes

Floats = NDArray[np.float64]

CONE, ELLIPSOID, LOFT = 0, 1, 2
LOFT_SAMPLES = 128


@dataclass
class SolidModel:
    """An ordered list of solids, each with a part name and the radius of its blend with those before."""

    rows: list[list[float]] = field(default_factory=list)
    parts: list[str] = field(default_factory=list)
    lofts: list[Floats] = field(default_factory=list)

    def cone(self, part: str, a: tuple, ra: float, b: tuple, rb: float, blend: float, cut: bool = False) -> None:
        """The hull of two balls: centres ``a``, ``b`` and radii in metres; ``cut`` subtracts it."""
        self._add(part, CONE, [*a, ra, *b, rb], blend, cut)

    def ellipsoid(
        self, part: str, centre: tuple, radii: tuple, blend: float, *, tilt: tuple = (0, 0, 0), cut: bool = False
    ) -> None:
        """An ellipsoid rotated by ``tilt`` (Euler XYZ, degrees) about its centre."""
        self._add(part, ELLIPSOID, [*centre, *radii, *np.radians(tilt)], blend, cut)

    def loft(self, part: str, axis: str, rows: list[tuple], blend: float) -> None:
        """A tube along ``axis`` ('x', 'y' or 'z').

        Rows (s, u, half_u, low_v, high_v, exponent): at position s the section's centre and half-width along u
        and its extent along v, where (u, v) are the other two axes: x → (z, y), y → (x, z), z → (x, y).
        """
        table = np.array(sorted(rows), np.float64)
        s = np.linspace(table[0, 0], table[-1, 0], LOFT_SAMPLES)
        self.lofts.append(PchipInterpolator(table[:, 0], table[:, 1:])(s))
        self._add(part, LOFT, ["xyz".index(axis), s[0], s[-1], len(self.lofts) - 1], blend, False)

    def distance(self, points: Floats, parts: set[str] | None = None) -> Floats:
        """Signed distance [N] of ``points`` [N, 3] to the union of all solids, or of those of ``parts``."""
        chosen = [i for i, part in enumerate(self.parts) if parts is None or part in parts]
        lofts = np.stack(self.lofts)
        return _distance(np.ascontiguousarray(points, np.float64), np.array(self.rows)[chosen], lofts)

    def _add(self, part: str, kind: int, values: list[float], blend: float, cut: bool) -> None:
        self.parts.append(part)
        self.rows.append([kind, blend, -1.0 if cut else 1.0, *values, *[0.0] * (9 - len(values))])


def smooth_min(a: Floats, b: Floats, blend: float) -> Floats:
    """Smooth minimum of two distances (quadratic polynomial), over differences below ``blend``."""
    h = np.maximum(blend - np.abs(a - b), 0.0) / blend
    return np.minimum(a, b) - h * h * blend / 4


def gradient(distance, points: Floats, step: float = 5e-4) -> Floats:
    """Central differences [N, 3] of the function ``distance`` at ``points`` [N, 3]."""
    offsets = step * np.eye(3)
    return np.stack([distance(points + o) - distance(points - o) for o in offsets], axis=1) / (2 * step)


def project(distance, points: Floats, steps: int = 3) -> Floats:
    """Move ``points`` [N, 3] onto the zero level of ``distance`` by damped Newton steps along its gradient."""
    for _ in range(steps):
        g = gradient(distance, points)
        move = distance(points) / np.maximum(np.sum(g * g, axis=1), 0.1)
        points = points - np.clip(move, -0.01, 0.01)[:, None] * g
    return points


def surface(distance, low: tuple, high: tuple, step: float) -> tuple[Floats, NDArray[np.int64]]:
    """Marching cubes over a box: vertices [V, 3] and faces [F, 3], counter-clockwise from outside.

    Only cells near the surface of a grid four times coarser are evaluated.
    """
    coarse = 4 * step
    counts = np.ceil((np.array(high) - low) / coarse).astype(int) + 1
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1)
    rough = distance(grid.reshape(-1, 3) * coarse + low).reshape(counts)
    field = zoom(rough, (4 * (counts - 1) + 1) / counts, order=1, grid_mode=False, mode="nearest")
    near = np.argwhere(np.abs(field) < 1.25 * coarse)
    field[tuple(near.T)] = distance(near * step + np.array(low))
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    return vertices * step + np.array(low), faces.astype(np.int64)


@njit(cache=True, fastmath=True)
def _cone(x, y, z, q):
    """Distance to a ball of linearly growing radius along a segment, at the point's projection."""
    dx, dy, dz = q[4] - q[0], q[5] - q[1], q[6] - q[2]
    length2 = dx * dx + dy * dy + dz * dz + 1e-12
    t = ((x - q[0]) * dx + (y - q[1]) * dy + (z - q[2]) * dz) / length2
    t = min(max(t, 0.0), 1.0)
    ex, ey, ez = x - q[0] - t * dx, y - q[1] - t * dy, z - q[2] - t * dz
    return np.sqrt(ex * ex + ey * ey + ez * ez) - (q[3] + t * (q[7] - q[3]))


@njit(cache=True, fastmath=True)
def _ellipsoid(x, y, z, q):
    x, y, z = x - q[0], y - q[1], z - q[2]
    c, s = np.cos(q[6]), np.sin(q[6])  # inverse rotations, X first
    y, z = c * y + s * z, c * z - s * y
    c, s = np.cos(q[7]), np.sin(q[7])
    x, z = c * x - s * z, c * z + s * x
    c, s = np.cos(q[8]), np.sin(q[8])
    x, y = c * x + s * y, c * y - s * x
    x, y, z = x / q[3], y / q[4], z / q[5]
    k0 = np.sqrt(x * x + y * y + z * z)
    k1 = np.sqrt((x / q[3]) ** 2 + (y / q[4]) ** 2 + (z / q[5]) ** 2) + 1e-9
    return k0 * (k0 - 1.0) / k1 if k0 > 1e-6 else -min(q[3], q[4], q[5])


@njit(cache=True, fastmath=True)
def _loft(x, y, z, q, lofts):
    axis = int(q[0])
    if axis == 0:
        s, u, v = x, z, y
    elif axis == 1:
        s, u, v = y, x, z
    else:
        s, u, v = z, x, y
    clamped = min(max(s, q[1]), q[2])
    position = (clamped - q[1]) / (q[2] - q[1]) * (LOFT_SAMPLES - 1)
    i = min(int(position), LOFT_SAMPLES - 2)
    f = position - i
    table = lofts[int(q[3])]
    centre_u = table[i, 0] * (1 - f) + table[i + 1, 0] * f
    half_u = table[i, 1] * (1 - f) + table[i + 1, 1] * f
    low = table[i, 2] * (1 - f) + table[i + 1, 2] * f
    high = table[i, 3] * (1 - f) + table[i + 1, 3] * f
    n = table[i, 4] * (1 - f) + table[i + 1, 4] * f
    half_v = 0.5 * (high - low)
    cap = min(half_u, half_v)
    a, b, c = abs(u - centre_u) / half_u, abs(v - 0.5 * (low + high)) / half_v, abs(s - clamped) / cap
    rho = (a**n + b**n + c**n) ** (1.0 / n)
    if rho < 0.05:
        return -0.9 * cap
    slope = np.sqrt((a ** (n - 1) / half_u) ** 2 + (b ** (n - 1) / half_v) ** 2 + (c ** (n - 1) / cap) ** 2)
    return (rho - 1.0) * rho ** (n - 1) / (slope + 1e-9)


@njit(cache=True, parallel=True, fastmath=True)
def _distance(points, rows, lofts):
    result = np.empty(len(points))
    for p in prange(len(points)):
        x, y, z = abs(points[p, 0]), points[p, 1], points[p, 2]
        d = 1e3
        for r in range(len(rows)):
            row = rows[r]
            q = row[3:]
            if row[0] == 0:
                e = _cone(x, y, z, q)
            elif row[0] == 1:
                e = _ellipsoid(x, y, z, q)
            else:
                e = _loft(x, y, z, q, lofts)
            k = row[1]
            if row[2] < 0:  # smooth maximum of d and -e
                h = max(k - abs(d + e), 0.0) / k
                d = max(d, -e) + h * h * k / 4
            else:
                h = max(k - abs(d - e), 0.0) / k
                d = min(d, e) - h * h * k / 4
        result[p] = d
    return result
