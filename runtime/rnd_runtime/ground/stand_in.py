"""Discs that stand for the body, in coordinates of the plane: across it twice, and above it."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32, floats
from rnd_runtime.core.gaussians import Gaussians

MAX_DISCS = 4096
GROWN, LARGEST_DISC = np.float32(1.2), np.float32(0.045)
"""factor on the discs' radii that closes the gaps of a thinned body; their bound, m, about that of a forearm"""
SINK = np.float32(0.8)
"""of a disc's radius, by which its centre lies below the surface"""
BANDS = np.array([0.12, 0.3, 0.6, 1.0, 1.5], np.float32)
"""m, heights between which discs are blurred alike"""
_FAR = np.float32(1e6)


class StandIn(NamedTuple):
    """Discs from low to high, by bands of height.

    Attributes:
        discs: [n, 4] m, two coordinates in the plane, height above it (not negative) and radius.
        starts: [7] first disc of each band, and n.
    """

    discs: Floats32
    starts: NDArray[np.int64]


def stand_in(gaussians: Gaussians, radii: Floats32, axes: NDArray[np.float64], offset: float) -> StandIn:
    """At most ``MAX_DISCS`` discs of the same surface; those of radius 0 or not finite are left out.

    Args:
        radii: [N] m of discs around the Gaussians.
        axes: [3, 3] by rows, two unit vectors in the plane and its normal.
        offset: m, of the plane along its normal.
    """
    arrays = floats(gaussians.means), floats(gaussians.normals), floats(radii), floats(axes)
    return StandIn(*_thinned(*arrays, np.float32(offset), BANDS))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _thinned(means, normals, radii, axes, offset, bands):  # type: ignore[no-untyped-def]
    casting = 0
    for i in range(len(radii)):
        casting += radii[i] > 0
    step = max(1, (casting + MAX_DISCS - 1) // MAX_DISCS)
    grown = GROWN * np.float32(np.sqrt(step))
    found = np.empty((casting // step + 1, 4), np.float32)
    band_of = np.empty(len(found), np.int64)
    starts = np.zeros(len(bands) + 2, np.int64)
    seen, count = 0, 0
    for i in range(len(radii)):
        if not radii[i] > 0:
            continue
        seen += 1
        if (seen - 1) % step:
            continue
        radius = min(radii[i] * grown, LARGEST_DISC)
        x = means[i, 0] - SINK * radius * normals[i, 0]
        y = means[i, 1] - SINK * radius * normals[i, 1]
        z = means[i, 2] - SINK * radius * normals[i, 2]
        if not abs(x) + abs(y) + abs(z) < _FAR:
            continue
        for axis in range(3):
            found[count, axis] = x * axes[axis, 0] + y * axes[axis, 1] + z * axes[axis, 2]
        found[count, 2] = max(found[count, 2] - offset, np.float32(0))
        found[count, 3] = radius
        band = 0
        for bound in bands:
            band += found[count, 2] >= bound
        band_of[count] = band
        starts[band + 1] += 1
        count += 1
    for band in range(len(bands) + 1):
        starts[band + 1] += starts[band]
    at, discs = starts.copy(), np.empty((count, 4), np.float32)
    for k in range(count):
        discs[at[band_of[k]]] = found[k]
        at[band_of[k]] += 1
    return discs, starts
