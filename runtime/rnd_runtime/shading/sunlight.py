"""What suns lay on Gaussians, sixteen at a time (numba over sixteen lanes): Lambert and GGX.

A mirror shows a disc of radius ρ at its own radiance: with E = πρ²L and D = 1/(πα²), E·D/(4 v·h) = L asks for
α² = ρ²/(4 v·h), where v·h = |l + v|/2 and the mean square angle is ρ²/2. Added to the surface's own α². A sun of one
texel is a point, see ``.sun``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rnd_runtime.core.simd import WIDTH, aligned_floats, lanes, load, root, select, store

from .brdf import ROUGHNESS_RANGE
from .lanes import (
    ALBEDO,
    CHUNK,
    FREE,
    NORMAL,
    ONE,
    ONE_OVER_PI,
    RADIANCE,
    ROUGHNESS,
    ROUGHNESS_LOW,
    TINY,
    VIEW,
    ZERO,
    at_least,
    clamped,
    enter,
    ggx_in_lanes,
    three,
    unit,
)

Floats32 = NDArray[np.float32]

# What faces away is seen only through what gaps the front leaves: 6 % of a back in the sun, white specks on a front in
# shade. Suns fade out over these n·v, chosen on training pictures of the dancer (36.19 dB without, 36.27 with).
TURNED_AWAY, AT_SILHOUETTE = np.float32(-0.2), np.float32(0)

_ROUGHNESS_HIGH = np.float32(ROUGHNESS_RANGE[1])
_OPEN = FREE  # a row of a thread's working memory
_ROOM = FREE + WIDTH


class SunArrays(NamedTuple):
    """S suns: where they are, what they lay on a surface that faces them, and how wide they are."""

    directions: Floats32  # [S, 3] unit
    irradiance: Floats32  # [S, 3]
    spread_squared: Floats32  # [S] rad²


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def add_suns(surfaces, visibility, camera, suns, seen, radiance):  # type: ignore[no-untyped-def]
    """Add what ``suns`` lay on the Gaussians ``seen`` [N] to ``radiance`` [N, 3], where ``visibility`` [N, S] is not 0.

    ``surfaces`` as of ``.shading_lanes.enter``, ``camera`` [3] m.
    """
    lit = np.empty(len(seen), np.bool_)
    for chunk in prange((len(seen) + CHUNK - 1) // CHUNK):
        members, room = np.empty(WIDTH, np.int64), aligned_floats(_ROOM)
        i, last = chunk * CHUNK, min((chunk + 1) * CHUNK, len(seen))
        for k in range(i, last):
            lit[k] = False
            for sun in range(visibility.shape[1]):
                lit[k] |= seen[k] and visibility[k, sun] > ZERO
        while i < last:
            i, count = enter(i, last, lit, surfaces, camera, members, room)
            if count > 0:
                _light_sixteen(members, visibility, suns, room)
                for k in range(count):
                    for channel in range(3):
                        radiance[members[k], channel] += room[RADIANCE + channel * WIDTH + k]


@njit(error_model="numpy")
def _light_sixteen(members, visibility, suns, room):  # type: ignore[no-untyped-def]
    """What the suns add, over the albedo in ``room``."""
    normal, view = three(room, NORMAL), unit(three(room, VIEW))
    n_dot_v = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    facing = clamped((n_dot_v - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), ONE)
    alpha = at_least(clamped(load(room, ROUGHNESS), _ROUGHNESS_HIGH), ROUGHNESS_LOW)
    alpha = alpha * alpha
    albedo = three(room, ALBEDO)
    red, green, blue = lanes(ZERO), lanes(ZERO), lanes(ZERO)
    for sun in range(len(suns.directions)):
        for k in range(WIDTH):
            room[_OPEN + k] = visibility[members[k], sun]
        lx, ly, lz = suns.directions[sun, 0], suns.directions[sun, 1], suns.directions[sun, 2]
        n_dot_l = normal[0] * lx + normal[1] * ly + normal[2] * lz
        arriving = at_least(facing * load(room, _OPEN) * n_dot_l, ZERO)
        hx, hy, hz = view[0] + lx, view[1] + ly, view[2] + lz
        half_squared = at_least(hx * hx + hy * hy + hz * hz, TINY)
        cx, cy = normal[1] * hz - normal[2] * hy, normal[2] * hx - normal[0] * hz
        cz = normal[0] * hy - normal[1] * hx
        sine_squared = (cx * cx + cy * cy + cz * cz) / half_squared
        alpha_squared = alpha * alpha + suns.spread_squared[sun] / root(half_squared)
        alpha_squared = select(alpha_squared < ONE, alpha_squared, ONE)
        shine = ggx_in_lanes(alpha_squared, n_dot_l, n_dot_v, sine_squared, half_squared)
        red += arriving * (albedo[0] * ONE_OVER_PI + shine) * suns.irradiance[sun, 0]
        green += arriving * (albedo[1] * ONE_OVER_PI + shine) * suns.irradiance[sun, 1]
        blue += arriving * (albedo[2] * ONE_OVER_PI + shine) * suns.irradiance[sun, 2]
    store(room, RADIANCE, red)
    store(room, RADIANCE + WIDTH, green)
    store(room, RADIANCE + 2 * WIDTH, blue)
