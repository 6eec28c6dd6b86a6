"""Shading on an OpenGL device: radiance of each Gaussian in one fragment.

GLSL versions of ``shading.ambient``, ``shading.tables``, ``shading.sum`` and ``shading.direct`` in the light probe's
frame: tables are uploaded once per light, and rotations are uniforms. Depth maps of directional lights: ``gl.shadow``.
"""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.shading.ambient import AmbientLight
from rnd_runtime.shading.lookup import DIFFUSE_SIZE, SPECULAR_SIZE
from rnd_runtime.shading.sh import SH_COUNT, sh_basis, sh_rotation
from rnd_runtime.shading.shader import Shader
from rnd_runtime.shading.shadow import axes_towards
from rnd_runtime.shading.specular_lobe import COSINE_COUNT, LOBE_WIDTHS, ROUGHNESS_COUNT, lobe_table
from rnd_runtime.shading.sum import DistantLights
from rnd_runtime.shading.tables import SkyTables

from .passes import GaussianTargets, Pass
from .shadow import ShadowMaps
from .surfaces import Surfaces

Floats32 = NDArray[np.float32]

_ROW_LIGHTS = 128  # lights in a row of their texture: 8192 fit into 768 × 64 texels
_LIGHT_TEXELS = 6
_DIFFUSE_TEXELS = 12  # of a node: sixteen numbers per colour
# Non-zero 4 × 4 blocks of a rotation of SH coefficients, in surface.glsl's order
_ROTATION_BLOCKS = ((0, 0), (1, 1), (1, 2), (2, 1), (2, 2), (2, 3), (3, 2), (3, 3))


class GlShading:
    """Shades as ``shading.shader.Shader`` on the device; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._shadows = ShadowMaps(context)
        self._passes: dict[tuple[type, int], Pass] = {}  # by kind of sky and number of directional lights
        self._sky: tuple[Any, dict[str, moderngl.Texture], dict[str, Any]] | None = None
        self._lobes: moderngl.Texture | None = None
        self._radiance = GaussianTargets(context, (4,))

    def shade(
        self,
        shader: Shader,
        surfaces: Surfaces,
        order: moderngl.Texture,
        ranks: int,
        eye: ArrayLike,
        root_rotation: ArrayLike,
    ) -> moderngl.Texture:
        """Linear radiance of ``ranks`` Gaussians towards ``eye`` [3] m, a texel per rank.

        Args:
            order: i4, the Gaussian of each rank. All Gaussians of ``surfaces`` cast shadows.
            root_rotation: [3, 3], root frame → frame of the surfaces.
        """
        light_to_world = shader.light_to_world
        textures, uniforms = self._sky_of(shader.sky)
        textures = {**textures, **surfaces.textures(), "order": order}
        if shader.directional:
            lights = shader.directional_arrays()
            axes = np.stack([axes_towards(direction) for direction in lights.directions])
            maps = self._shadows.draw(surfaces.points, surfaces.normals, surfaces.gaussians, axes)
            textures |= {"depths": maps.depths, "bounds": maps.bounds}
            uniforms = uniforms | {
                "light_axes": maps.axes,
                "light_directions": np.array([light.direction for light in shader.directional]),
                "light_irradiances": lights.irradiance,
                "light_blurs": lights.spread_squared,
            }
        program = self._pass_of(shader)
        (radiance,), _ = self._radiance.reserve(ranks)
        program.bind(
            textures,
            count=ranks,
            eye=np.asarray(eye, np.float32),
            world_to_light=light_to_world,  # uploaded by column, which transposes it
            turn=_rotation_blocks(sh_rotation(light_to_world.T @ np.asarray(root_rotation, np.float64))),
            **uniforms,
        )
        self._context.enable_only(moderngl.NOTHING)
        program.fill()
        return radiance

    def release(self) -> None:
        self._shadows.release()
        for program in self._passes.values():
            program.release()
        self._passes = {}
        self._forget_sky()
        self._radiance.release()
        if self._lobes is not None:
            self._lobes.release()
            self._lobes = None

    def _forget_sky(self) -> None:
        if self._sky is not None:
            for texture in self._sky[1].values():
                texture.release()
            self._sky = None

    def _sky_of(
        self, sky: AmbientLight | SkyTables | DistantLights
    ) -> tuple[dict[str, moderngl.Texture], dict[str, Any]]:
        """Textures and uniforms of a sky, uploaded when it changes."""
        if self._sky is None or self._sky[0] is not sky:
            self._forget_sky()
            made: dict[str, Floats32] = {}
            uniforms: dict[str, Any] = {}
            if isinstance(sky, AmbientLight):
                uniforms["ambient"] = sky.coefficients.T
            elif isinstance(sky, SkyTables):
                made["diffuse"] = sky.diffuse.reshape(DIFFUSE_SIZE, DIFFUSE_SIZE * _DIFFUSE_TEXELS, 4)
                made["specular"] = sky.specular.reshape(len(LOBE_WIDTHS) * SPECULAR_SIZE, SPECULAR_SIZE, 3)
            else:
                made["distant"] = _light_rows(sky)
                uniforms["lights"] = len(sky.directions)
            textures = {name: self._constant(values) for name, values in made.items()}
            self._sky = sky, textures, uniforms
        if self._lobes is None:
            lobes = np.zeros((ROUGHNESS_COUNT, COSINE_COUNT, 8), np.float32)
            lobes[..., : lobe_table().shape[-1]] = lobe_table()
            self._lobes = self._constant(lobes.reshape(ROUGHNESS_COUNT, 2 * COSINE_COUNT, 4))
        return {**self._sky[1], "lobes": self._lobes}, self._sky[2]

    def _constant(self, values: NDArray[Any]) -> moderngl.Texture:
        """A texture of ``values`` [H, W, components]."""
        height, width, components = values.shape
        data = np.ascontiguousarray(values, np.float32)
        texture = self._context.texture((width, height), components, data, dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def _pass_of(self, shader: Shader) -> Pass:
        key = type(shader.sky), len(shader.directional)
        if key not in self._passes:
            parts = {
                AmbientLight: ("lobe.glsl", "sky_ambient.glsl"),
                SkyTables: ("lobe.glsl", "sky_table.glsl"),
                DistantLights: ("sky_lights.glsl",),
            }[key[0]]
            macros = {"ROW_LIGHTS": _ROW_LIGHTS}
            if shader.directional:
                macros["LIGHTS"] = len(shader.directional)
                parts = (*parts, "shadow_map.glsl", "direct.glsl")
            fragment = ("sh.glsl", "ggx.glsl", "surface.glsl", *parts, "shade.frag")
            self._passes[key] = Pass(self._context, ("fill.vert",), fragment, macros)
        return self._passes[key]


def _rotation_blocks(rotation: NDArray[np.float64]) -> Floats32:
    """Blocks [8, 4, 4] of a rotation [16, 16] of SH coefficients, by column."""
    blocks = rotation.reshape(4, 4, 4, 4).swapaxes(1, 2)  # row of blocks, column of blocks, row, column
    return np.asarray(np.stack([blocks[at].T for at in _ROTATION_BLOCKS]), np.float32)


def _light_rows(lights: DistantLights) -> Floats32:
    """[rows, _ROW_LIGHTS · 6, 4]: direction and flux.r; flux.g, flux.b; sixteen SH coefficients of the direction."""
    rows = max(-(-len(lights.directions) // _ROW_LIGHTS), 1)
    packed = np.zeros((rows * _ROW_LIGHTS, _LIGHT_TEXELS, 4), np.float32)
    used = packed[: len(lights.directions)].reshape(-1, 4 * _LIGHT_TEXELS)
    used[:, :3], used[:, 3:6] = lights.directions, lights.flux
    used[:, 8 : 8 + SH_COUNT] = sh_basis(lights.directions)
    return packed.reshape(rows, _ROW_LIGHTS * _LIGHT_TEXELS, 4)
