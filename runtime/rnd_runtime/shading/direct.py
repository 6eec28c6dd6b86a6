"""Direct light of directional lights on Gaussians, Lambert and GGX (numba, sixteen lanes).

A light of radius ρ widens the lobe. A mirror shows the disc at its own radiance L: with E = πρ²L and D = 1/(πα²),
E·D/(4 v·h) = L requires α² = ρ²/(4 v·h), where v·h = |l + v|/2 and the mean square angle is ρ²/2. It is added to the
surface's α².
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rnd_runtime.core.simd.arithmetic import at_least, lanes, select, sqrt
from rnd_runtime.core.simd.memory import aligned_floats, load, store
from rnd_runtime.core.simd.vectors import WIDTH

from .brdf import ROUGHNESS_RANGE, ggx_lanes, specular_share_lanes
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
    clamped,
    gather,
    load3,
    unit,
)

Floats32 = NDArray[np.float32]

# n·v over which light fades out, as 6 % of Gaussians that face away show through gaps of the front. Chosen on training
# images of the dancer: 36.27 dB, 36.19 dB without.
TURNED_AWAY, AT_SILHOUETTE = np.float32(-0.2), np.float32(0)

_ROUGHNESS_HIGH = np.float32(ROUGHNESS_RANGE[1])
_OPEN = FREE  # a row of scratch
_SCRATCH = FREE + WIDTH


class DirectionalArrays(NamedTuple):
    """S directional lights."""

    directions: Floats32  # [S, 3] unit
    irradiance: Floats32  # [S, 3] on a surface that faces the light
    spread_squared: Floats32  # [S] rad²


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def add_directional(surfaces, visibility, camera, lights, visible, radiance):  # type: ignore[no-untyped-def]
    """Add direct light on the Gaussians ``visible`` [N] to ``radiance`` [N, 3], where ``visibility`` [N, S] is not 0.

    ``surfaces`` as for ``.lanes.gather``; ``camera`` [3] m.
    """
    lit = np.empty(len(visible), np.bool_)
    for chunk in prange((len(visible) + CHUNK - 1) // CHUNK):
        indices, scratch = np.empty(WIDTH, np.int64), aligned_floats(_SCRATCH)
        i, last = chunk * CHUNK, min((chunk + 1) * CHUNK, len(visible))
        for k in range(i, last):
            lit[k] = False
            for light in range(visibility.shape[1]):
                lit[k] |= visible[k] and visibility[k, light] > ZERO
        while i < last:
            i, count = gather(i, last, lit, surfaces, camera, indices, scratch)
            if count > 0:
                _light_sixteen(indices, visibility, lights, scratch)
                for k in range(count):
                    for channel in range(3):
                        radiance[indices[k], channel] += scratch[RADIANCE + channel * WIDTH + k]


@njit(error_model="numpy")
def _light_sixteen(indices, visibility, lights, scratch):  # type: ignore[no-untyped-def]
    """Direct light, written over the albedo in ``scratch``."""
    normal, view = load3(scratch, NORMAL), unit(load3(scratch, VIEW))
    n_dot_v = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    facing = clamped((n_dot_v - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), ONE)
    alpha = at_least(clamped(load(scratch, ROUGHNESS), _ROUGHNESS_HIGH), ROUGHNESS_LOW)
    alpha = alpha * alpha
    albedo = load3(scratch, ALBEDO)
    share = specular_share_lanes(*albedo)
    red, green, blue = lanes(ZERO), lanes(ZERO), lanes(ZERO)
    for light in range(len(lights.directions)):
        for k in range(WIDTH):
            scratch[_OPEN + k] = visibility[indices[k], light]
        lx, ly, lz = lights.directions[light, 0], lights.directions[light, 1], lights.directions[light, 2]
        n_dot_l = normal[0] * lx + normal[1] * ly + normal[2] * lz
        visible_cosine = at_least(facing * load(scratch, _OPEN) * n_dot_l, ZERO)
        hx, hy, hz = view[0] + lx, view[1] + ly, view[2] + lz
        half_squared = at_least(hx * hx + hy * hy + hz * hz, TINY)
        cx, cy = normal[1] * hz - normal[2] * hy, normal[2] * hx - normal[0] * hz
        cz = normal[0] * hy - normal[1] * hx
        sine_squared = (cx * cx + cy * cy + cz * cz) / half_squared
        alpha_squared = alpha * alpha + lights.spread_squared[light] / sqrt(half_squared)
        alpha_squared = select(alpha_squared < ONE, alpha_squared, ONE)
        specular = share * ggx_lanes(alpha_squared, n_dot_l, n_dot_v, sine_squared, half_squared)
        red += visible_cosine * (albedo[0] * ONE_OVER_PI + specular) * lights.irradiance[light, 0]
        green += visible_cosine * (albedo[1] * ONE_OVER_PI + specular) * lights.irradiance[light, 1]
        blue += visible_cosine * (albedo[2] * ONE_OVER_PI + specular) * lights.irradiance[light, 2]
    store(scratch, RADIANCE, red)
    store(scratch, RADIANCE + WIDTH, green)
    store(scratch, RADIANCE + 2 * WIDTH, blue)
