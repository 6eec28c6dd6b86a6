"""Relighting of posed Gaussians, by modes of increasing cost.

============  =====================================================================================
ao            sixteen SH coefficients of light times ambient occlusion
table         the full map through tables over the normal; soft shadows from the visibility
table+sun     the same without the sun, which gets its own highlight and a shadow from a depth map
lights:K      K lights of equal luminance (median cut), each with the full BRDF
brute         every texel of the downsized map: the light of training
============  =====================================================================================

All but ``table+sun`` approximate ``shading.reference.shade_reference``, whose shadows and highlights blur the sun.
"""

from __future__ import annotations

import re

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats, mask, shallow_copy
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
# Disc radius in the depth map in standard deviations: the distance of a trained avatar's neighbours. 2 σ speckles
# limbs where normals disagree.
DISC_SIGMAS = 1.4
CASTING_OPACITY = 0.5  # min opacity that casts a shadow


class Shader:
    """Shades Gaussians under one light; built once per light, called for every frame.

    Args:
        light: the probe. ``with_yaw`` changes its yaw at no cost.
        mode: one of SHADE_MODES, with a number for K.
        texels: (height, width) the probe is downsized to. Visibility has degree 3 and is trained on 32 × 64; more
            changes highlights below roughness 0.4 only.

    Attributes:
        light_to_world: [3, 3], the probe's frame → that of the Gaussians, see ``in_frame``.
        sky: the light without directional lights, as the mode represents it.
        directional: lights that ``table+sun`` extracted from the map.

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
        self._in_probe = (  # DirectionalArrays with directions in the light probe's frame
            np.array([light_.direction for light_ in self.directional]).reshape(-1, 3),
            np.array([light_.irradiance for light_ in self.directional], np.float32).reshape(-1, 3),
            np.array([light_.spread**2 for light_ in self.directional], np.float32),
        )

    def with_yaw(self, yaw: float) -> Shader:
        """The same light at another ``yaw`` (radians, as ``Light``); shares all tables."""
        light = self.light.with_yaw(yaw)
        return shallow_copy(self, light=light, light_to_world=light.rotation)

    def in_frame(self, frame_to_world: ArrayLike) -> Shader:
        """The same light for Gaussians in another frame; ``frame_to_world`` [3, 3] rotates it to the world's axes."""
        return shallow_copy(self, light_to_world=np.asarray(frame_to_world, np.float64).T @ self.light.rotation)

    def shade(
        self,
        gaussians: Gaussians,
        camera_position: ArrayLike,
        visible: ArrayLike | None = None,
        *,
        sunlit: Floats32 | None = None,
    ) -> Floats32:
        """Linear radiance [N, 3], not negative, of each Gaussian towards the camera at [3] m.

        Gaussians that are not ``visible`` [N] keep radiance 0; all are visible by default. ``sunlit`` is as returned by
        the method of that name, which gives it by default.
        """
        light_to_world = self.light_to_world
        visible = mask(visible, len(gaussians.means))
        radiance = self.sky.shade(gaussians, camera_position, light_to_world, visible)
        if self.directional and len(radiance):
            sunlit = self.sunlit(gaussians, visible) if sunlit is None else floats(sunlit)
            surfaces = (gaussians.means, gaussians.normals, gaussians.albedo, gaussians.roughness, gaussians.visibility)
            eye = np.array(camera_position, np.float32)
            lights = self.directional_arrays()
            add_directional(tuple(floats(a) for a in surfaces), sunlit, eye, lights, visible, radiance)
        return radiance

    def sunlit(self, gaussians: Gaussians, receivers: ArrayLike | None = None) -> Floats32:
        """Share [N, S] of each directional light that reaches the Gaussians' surfaces past all of them.

        0 where not among ``receivers`` [N].
        """
        if not self.directional:
            return np.empty((len(gaussians.means), 0), np.float32)
        return directional_visibility(
            gaussians.means,
            gaussians.normals,
            self.directional_arrays().directions,
            radii=shadow_radii(gaussians),
            resolution=SHADOW_RESOLUTION,
            receivers=receivers,
        )

    def directional_arrays(self) -> DirectionalArrays:
        """Directional lights as kernel arrays, in the frame of the Gaussians."""
        directions, irradiance, spreads = self._in_probe
        if not self.directional:
            return DirectionalArrays(irradiance, irradiance, spreads)
        in_frame = directions @ self.light_to_world.T
        return DirectionalArrays(np.array(in_frame, np.float32, order="C"), irradiance, spreads)


def check_mode(mode: str) -> None:
    """Raise ``InputError`` unless ``mode`` is valid."""
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
    """Disc radius [N] m of each Gaussian in a depth map; a flat one's covariance trace is 2 σ²."""
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
