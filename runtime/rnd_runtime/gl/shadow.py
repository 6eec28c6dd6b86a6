"""Depth maps of directional lights on an OpenGL device, as in ``shading.shadow``; read by ``direct.glsl``.

Maps keep the nearest depth by max blending in float32. Their bounds are found on the device, by max blending onto one
texel per light.
"""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.shading.shader import SHADOW_RESOLUTION

from .passes import Pass

Floats32 = NDArray[np.float32]

_BLOCK = 32  # Gaussians per vertex that finds bounds
_FARTHEST = -1e30  # m, empty texel


class DepthMaps(NamedTuple):
    """Input of the shading pass for S lights."""

    depths: moderngl.Texture  # [S · SHADOW_RESOLUTION, SHADOW_RESOLUTION] m towards the light
    bounds: moderngl.Texture  # [1, S, 4]
    axes: Floats32  # [S, 3, 3] world → map, by column


class ShadowMaps:
    """Renders depth maps of a few lights; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._made: dict[int, _LightTargets] = {}  # by the number of lights

    def draw(self, points: moderngl.Texture, normals: moderngl.Texture, count: int, axes: Floats32) -> DepthMaps:
        """Maps of ``count`` Gaussians in ``gl.passes.GaussianTexture``s.

        Args:
            points: mean m, world, and disc radius m (0 casts no shadow).
            normals: unit, world.
            axes: [S, 3, 3] of ``shading.shadow.axes_towards`` each light, world.
        """
        lights = len(axes)
        if lights not in self._made:
            self._made[lights] = _LightTargets(self._context, lights)
        made = self._made[lights]
        axes_by_column = np.ascontiguousarray(axes.swapaxes(1, 2), np.float32)
        self._context.enable_only(moderngl.BLEND)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        self._context.blend_equation = moderngl.MAX, moderngl.MAX
        textures = {"points": points, "normals": normals, "bounds": made.bounds}
        made.bounds_target.use()
        made.bounds_target.clear(_FARTHEST, _FARTHEST, _FARTHEST, _FARTHEST)
        made.surround.bind(textures, light_axes=axes_by_column, count=count)
        made.surround.render(moderngl.POINTS, lights * -(-count // _BLOCK))
        made.depths_target.use()
        made.depths_target.clear(_FARTHEST)
        made.discs.bind(textures, light_axes=axes_by_column, count=count)
        made.discs.render(moderngl.TRIANGLES, 6 * lights * count)
        self._context.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
        return DepthMaps(made.depths, made.bounds, axes_by_column)

    def release(self) -> None:
        for made in self._made.values():
            made.release()
        self._made = {}


class _LightTargets:
    """Programs and targets for a number of lights."""

    def __init__(self, context: moderngl.Context, lights: int) -> None:
        macros = {"LIGHTS": lights, "BLOCK": _BLOCK}
        self.surround = Pass(context, ("shadow_bounds.vert",), ("shadow_bounds.frag",), macros)
        self.discs = Pass(context, ("shadow_map.glsl", "shadow_discs.vert"), ("shadow_discs.frag",), macros)
        size = (SHADOW_RESOLUTION, lights * SHADOW_RESOLUTION)
        self.bounds = context.texture((lights, 1), 4, dtype="f4")
        self.depths = context.texture(size, 1, dtype="f4")
        self.bounds_target = context.framebuffer([self.bounds])
        self.depths_target = context.framebuffer([self.depths])

    def release(self) -> None:
        for part in (self.surround, self.discs, self.bounds_target, self.depths_target, self.bounds, self.depths):
            part.release()
