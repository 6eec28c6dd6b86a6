"""Relighting posed Gaussians, at whatever price per frame one is willing to pay.

============  =====================================================================================
ao            sixteen harmonics of light times ambient occlusion
table         the whole map through tables over the normal; soft shadows from the visibility
table+sun     the same, with the sun taken out, its own highlight and a hard shadow from a depth map
lights:K      K lights of equal luminance (median cut), each with the whole BRDF
brute         every texel of the downsized map: what the avatar was trained with
============  =====================================================================================

All but ``table+sun`` approximate the same sum, :func:`rnd_runtime.shading_reference.shade_reference`.
``table+sun`` is nearer to the truth than that sum, whose shadows and highlights blur the sun.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._raster_input import floats, mask
from ._twin import twin
from .brdf import ROUGHNESS_RANGE, ggx32
from .errors import InputError
from .gaussians import Gaussians
from .light import Light
from .shading_ambient import AmbientLight
from .shading_sum import DistantLights
from .shading_tables import SkyTables
from .shadow import directional_visibility
from .sun import Sun, extract_suns

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

SHADE_MODES = ("ao", "table", "table+sun", "lights:K", "brute")
_MOST_LIGHTS = 8192
SHADOW_RESOLUTION = 384  # texels along a body: 5 mm
# A Gaussian's disc in the depth map, in standard deviations: neighbours of a trained avatar stand 1.4 σ apart. Discs
# of 2 σ hide nothing more, but rise above their neighbours where normals disagree: speckled thighs.
DISC_SIGMAS = 1.4
CASTING_OPACITY = 0.5  # what is more transparent casts no shadow
# What faces away is seen only through what gaps the front leaves: 6 % of a back in the sun, white specks on a front in
# shade. Suns fade out over these n·v, chosen on training pictures of the dancer (36.19 dB without, 36.27 with).
TURNED_AWAY, AT_SILHOUETTE = np.float32(-0.2), np.float32(0)

_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-12)
_ONE_OVER_PI = np.float32(1 / np.pi)
_ROUGHNESS_LOW, _ROUGHNESS_HIGH = (np.float32(bound) for bound in ROUGHNESS_RANGE)


class SunArrays(NamedTuple):
    """S suns: where they are, what they lay on a surface that faces them, and how wide they are."""

    directions: Floats32  # [S, 3] unit
    irradiance: Floats32  # [S, 3]
    spread_squared: Floats32  # [S] rad²


class Shader:
    """Shades Gaussians under one light; built once for a light, called for every frame.

    Args:
        light: the probe. Its yaw can change later by :meth:`turned` at no cost.
        mode: one of SHADE_MODES, with a number for K.
        texels: (height, width) the probe is downsized to, suns excepted. An avatar's visibility has degree 3
            and was trained on 32 × 64; more changes highlights below roughness 0.4 only.

    Attributes:
        light_to_world: [3, 3], the probe's frame → that of the Gaussians that are shaded, see :meth:`in_frame`.
        sky: all the light but the suns, as the mode has it.
        suns: what ``table+sun`` took out of the map; empty when nothing in it is bright and compact enough.

    Raises:
        InputError: the mode is none of SHADE_MODES.
    """

    def __init__(self, light: Light, mode: str = "table+sun", *, texels: tuple[int, int] = (32, 64)) -> None:
        self.light, self.mode = light, mode
        self.light_to_world = light.rotation
        self.suns: tuple[Sun, ...] = ()
        self.sky: AmbientLight | SkyTables | DistantLights
        if mode == "ao":
            self.sky = AmbientLight.project(light, texels)
        elif mode == "table":
            self.sky = SkyTables.build(light, texels)
        elif mode == "table+sun":
            sky, self.suns = extract_suns(light)
            self.sky = SkyTables.build(sky, texels)
        elif mode == "brute":
            self.sky = DistantLights.all_texels(light, texels)
        else:
            self.sky = DistantLights.median_cut(light, _light_count(mode))
        self._in_probe = (  # what sun_arrays returns, with directions in the light probe's frame
            np.array([sun.direction for sun in self.suns]).reshape(-1, 3),
            np.array([sun.irradiance for sun in self.suns], np.float32).reshape(-1, 3),
            np.array([sun.spread**2 for sun in self.suns], np.float32),
        )

    def turned(self, yaw: float) -> Shader:
        """The same light at another ``yaw`` (radians, as :class:`Light`); shares all tables."""
        light = self.light.turned(yaw)
        return twin(self, light=light, light_to_world=light.rotation)

    def in_frame(self, frame_to_world: ArrayLike) -> Shader:
        """The same light for Gaussians in a frame that ``frame_to_world`` [3, 3] turns to the world's axes."""
        return twin(self, light_to_world=np.asarray(frame_to_world, np.float64).T @ self.light.rotation)

    def shade(
        self,
        gaussians: Gaussians,
        camera_position: ArrayLike,
        seen: ArrayLike | None = None,
        *,
        sun_shadows: bool = True,
    ) -> Floats32:
        """Linear radiance [N, 3], not negative, that each Gaussian sends to the camera at [3] m.

        Gaussians that face away from the camera are shaded too: at a silhouette they are seen. Those that are
        not ``seen`` [N] (by default all are) keep radiance 0 and cast shadows all the same. Without
        ``sun_shadows`` nothing stands in the way of the suns, as for models that know of no shadows.
        """
        light_to_world = self.light_to_world
        seen = mask(seen, len(gaussians.means))
        radiance = self.sky.shade(gaussians, camera_position, light_to_world, seen)
        if self.suns and len(radiance):
            suns = self.sun_arrays()
            visibility = np.ones((len(radiance), len(suns.directions)), np.float32)
            if sun_shadows:
                visibility = directional_visibility(
                    gaussians.means,
                    gaussians.normals,
                    suns.directions,
                    radii=shadow_radii(gaussians),
                    resolution=SHADOW_RESOLUTION,
                    receivers=seen,
                )
            surfaces = gaussians.means, gaussians.normals, gaussians.albedo, gaussians.roughness
            eye = np.array(camera_position, np.float32)
            add_suns(tuple(floats(a) for a in surfaces), floats(visibility), eye, suns, seen, radiance)
        return radiance

    def sun_arrays(self) -> SunArrays:
        """The suns as kernels want them, in the frame of the Gaussians."""
        directions, irradiance, spreads = self._in_probe
        if not self.suns:
            return SunArrays(irradiance, irradiance, spreads)
        turned = directions @ self.light_to_world.T
        return SunArrays(np.array(turned, np.float32, order="C"), irradiance, spreads)


def check_mode(mode: str) -> None:
    """Raise :class:`InputError` unless ``mode`` is one that a :class:`Shader` knows."""
    if mode not in SHADE_MODES or mode == "lights:K":
        _light_count(mode)


def _light_count(mode: str) -> int:
    match = re.fullmatch(r"lights:(\d{1,6})", mode)
    count = int(match[1]) if match else 0
    if not 1 <= count <= _MOST_LIGHTS:
        raise InputError(
            "shading mode", expected=f"one of {', '.join(SHADE_MODES)} (K from 1 to {_MOST_LIGHTS})", got=mode
        )
    return count


def shadow_radii(gaussians: Gaussians) -> Floats32:
    """Disc radius [N] m of each Gaussian in a depth map; flat ones have σ² twice in the trace."""
    radii: Floats32 = disc_radii(floats(gaussians.covariances), floats(gaussians.opacities))
    return radii


@numba.njit(nogil=True, cache=True, error_model="numpy")
def disc_radii(covariances, opacities):  # type: ignore[no-untyped-def]
    """:func:`shadow_radii` of covariances [N, 6] and opacities [N]."""
    radii = np.empty(len(opacities), np.float32)
    for i in range(len(radii)):
        trace = covariances[i, 0] + covariances[i, 3] + covariances[i, 5]
        radii[i] = DISC_SIGMAS * np.sqrt(trace / 2) if opacities[i] > CASTING_OPACITY else 0
    return radii


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def add_suns(surfaces, visibility, camera, suns, seen, radiance):  # type: ignore[no-untyped-def]
    """Add what ``suns`` lay on the Gaussians to ``radiance`` [N, 3]. A sun of one texel is a point: see ``sun``."""
    # A mirror shows a disc of radius ρ at its own radiance: with E = πρ²L and D = 1/(πα²), E·D/(4 v·h) = L asks
    # for α² = ρ²/(4 v·h), where v·h = |l + v|/2 and the mean square angle is ρ²/2. Added to the surface's own.
    means, normals, albedo, roughness = surfaces
    directions, irradiance, spread_squared = suns
    for i in numba.prange(len(means)):
        if not seen[i]:
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        vx, vy, vz = camera[0] - means[i, 0], camera[1] - means[i, 1], camera[2] - means[i, 2]
        distance = max(np.sqrt(vx * vx + vy * vy + vz * vz), _TINY)
        vx, vy, vz = vx / distance, vy / distance, vz / distance
        n_dot_v = nx * vx + ny * vy + nz * vz
        facing = min((n_dot_v - TURNED_AWAY) / (AT_SILHOUETTE - TURNED_AWAY), _ONE)
        if not facing > _ZERO:
            continue
        alpha = min(max(roughness[i], _ROUGHNESS_LOW), _ROUGHNESS_HIGH)
        alpha *= alpha
        for sun in range(len(directions)):
            lx, ly, lz = directions[sun, 0], directions[sun, 1], directions[sun, 2]
            n_dot_l = nx * lx + ny * ly + nz * lz
            arriving = facing * visibility[i, sun] * n_dot_l
            if not arriving > _ZERO:
                continue
            hx, hy, hz = lx + vx, ly + vy, lz + vz
            half_squared = max(hx * hx + hy * hy + hz * hz, _TINY)
            cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
            sine_squared = (cx * cx + cy * cy + cz * cz) / half_squared
            blur = spread_squared[sun] / np.sqrt(half_squared)
            shine = ggx32(
                min(alpha * alpha + blur, _ONE),
                n_dot_l,
                n_dot_v,
                sine_squared,
                half_squared,
            )
            for channel in range(3):
                reflectance = albedo[i, channel] * _ONE_OVER_PI + shine
                radiance[i, channel] += arriving * reflectance * irradiance[sun, channel]
