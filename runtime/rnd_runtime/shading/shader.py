"""Relighting posed Gaussians, at whatever price per frame one is willing to pay.

============  =====================================================================================
ao            sixteen SH coefficients of light times ambient occlusion
table         the whole map through tables over the normal; soft shadows from the visibility
table+sun     the same, with the sun taken out, its own highlight and a hard shadow from a depth map
lights:K      K lights of equal luminance (median cut), each with the whole BRDF
brute         every texel of the downsized map: what the avatar was trained with
============  =====================================================================================

All but ``table+sun`` approximate the same sum, ``shading.reference.shade_reference``.
``table+sun`` is nearer to the truth than that sum, whose shadows and highlights blur the sun.
"""

from __future__ import annotations

import re

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, mask
from rnd_runtime.core.copies import shallow_copy
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians

from .ambient import AmbientLight
from .direct import DirectionalArrays, add_directional
from .directional import DirectionalLight, extract_directional
from .light import Light
from .shadow import directional_visibility
from .sum import DistantLights
from .tables import SkyTables

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

SHADE_MODES = ("ao", "table", "table+sun", "lights:K", "brute")
_MAX_LIGHTS = 8192
SHADOW_RESOLUTION = 384  # texels along a body: 5 mm
# A Gaussian's disc in the depth map, in standard deviations: neighbours of a trained avatar stand 1.4 σ apart. Discs
# of 2 σ hide nothing more, but rise above their neighbours where normals disagree: speckled thighs.
DISC_SIGMAS = 1.4
CASTING_OPACITY = 0.5  # what is more transparent casts no shadow


class Shader:
    """Shades Gaussians under one light; built once for a light, called for every frame.

    Args:
        light: the probe. Its yaw can change later by ``turned`` at no cost.
        mode: one of SHADE_MODES, with a number for K.
        texels: (height, width) the probe is downsized to; an avatar's visibility has degree 3
            and was trained on 32 × 64; more changes highlights below roughness 0.4 only.

    Attributes:
        light_to_world: [3, 3], the probe's frame → that of the Gaussians that are shaded, see ``in_frame``.
        sky: all the light but the directional lights, as the mode has it.
        directional: lights that ``table+sun`` took out of the map, if any are bright and compact enough.

    Raises:
        InputError: the mode is none of SHADE_MODES.
    """

    def __init__(self, light: Light, mode: str = "table+sun", *, texels: tuple[int, int] = (32, 64)) -> None:
        self.light, self.mode = light, mode
        self.light_to_world = light.rotation
        self.directional: tuple[DirectionalLight, ...] = ()
        self.sky: AmbientLight | SkyTables | DistantLights
        if mode == "ao":
            self.sky = AmbientLight.project(light, texels)
        elif mode == "table":
            self.sky = SkyTables.build(light, texels)
        elif mode == "table+sun":
            sky, self.directional = extract_directional(light)
            self.sky = SkyTables.build(sky, texels)
        elif mode == "brute":
            self.sky = DistantLights.all_texels(light, texels)
        else:
            self.sky = DistantLights.median_cut(light, _light_count(mode))
        self._in_probe = (  # what directional_arrays returns, with directions in the light probe's frame
            np.array([light_.direction for light_ in self.directional]).reshape(-1, 3),
            np.array([light_.irradiance for light_ in self.directional], np.float32).reshape(-1, 3),
            np.array([light_.spread**2 for light_ in self.directional], np.float32),
        )

    def turned(self, yaw: float) -> Shader:
        """The same light at another ``yaw`` (radians, as ``Light``); shares all tables."""
        light = self.light.turned(yaw)
        return shallow_copy(self, light=light, light_to_world=light.rotation)

    def in_frame(self, frame_to_world: ArrayLike) -> Shader:
        """The same light for Gaussians in a frame that ``frame_to_world`` [3, 3] turns to the world's axes."""
        return shallow_copy(self, light_to_world=np.asarray(frame_to_world, np.float64).T @ self.light.rotation)

    def shade(
        self, gaussians: Gaussians, camera_position: ArrayLike, seen: ArrayLike | None = None, *, shadows: bool = True
    ) -> Floats32:
        """Linear radiance [N, 3], not negative, that each Gaussian sends to the camera at [3] m.

        Gaussians that face away from the camera are shaded too: at a silhouette they are seen. Those that are
        not ``seen`` [N] (by default all are) keep radiance 0 and cast shadows all the same. Without
        ``shadows`` nothing stands in the way of the directional lights, as for models that know of no shadows.
        """
        light_to_world = self.light_to_world
        seen = mask(seen, len(gaussians.means))
        radiance = self.sky.shade(gaussians, camera_position, light_to_world, seen)
        if self.directional and len(radiance):
            lights = self.directional_arrays()
            visibility = np.ones((len(radiance), len(lights.directions)), np.float32)
            if shadows:
                visibility = directional_visibility(
                    gaussians.means,
                    gaussians.normals,
                    lights.directions,
                    radii=shadow_radii(gaussians),
                    resolution=SHADOW_RESOLUTION,
                    receivers=seen,
                )
            surfaces = (gaussians.means, gaussians.normals, gaussians.albedo, gaussians.roughness, gaussians.visibility)
            eye = np.array(camera_position, np.float32)
            add_directional(tuple(floats(a) for a in surfaces), floats(visibility), eye, lights, seen, radiance)
        return radiance

    def directional_arrays(self) -> DirectionalArrays:
        """The directional lights as kernels want them, in the frame of the Gaussians."""
        directions, irradiance, spreads = self._in_probe
        if not self.directional:
            return DirectionalArrays(irradiance, irradiance, spreads)
        turned = directions @ self.light_to_world.T
        return DirectionalArrays(np.array(turned, np.float32, order="C"), irradiance, spreads)


def check_mode(mode: str) -> None:
    """Raise ``InputError`` unless ``mode`` is one that a ``Shader`` knows."""
    if mode not in SHADE_MODES or mode == "lights:K":
        _light_count(mode)


def _light_count(mode: str) -> int:
    match = re.fullmatch(r"lights:(\d{1,6})", mode)
    count = int(match[1]) if match else 0
    if not 1 <= count <= _MAX_LIGHTS:
        raise InputError(
            "shading mode", expected=f"one of {', '.join(SHADE_MODES)} (K from 1 to {_MAX_LIGHTS})", got=mode
        )
    return count


def shadow_radii(gaussians: Gaussians) -> Floats32:
    """Disc radius [N] m of each Gaussian in a depth map; flat ones have σ² twice in the trace."""
    radii: Floats32 = disc_radii(floats(gaussians.covariances), floats(gaussians.opacities))
    return radii


@numba.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def disc_radii(covariances, opacities):  # type: ignore[no-untyped-def]
    """``shadow_radii`` of covariances [N, 6] and opacities [N]."""
    radii = np.empty(len(opacities), np.float32)
    for i in numba.prange(len(radii)):
        trace = covariances[i, 0] + covariances[i, 3] + covariances[i, 5]
        radii[i] = DISC_SIGMAS * np.sqrt(trace / 2) if opacities[i] > CASTING_OPACITY else 0
    return radii
