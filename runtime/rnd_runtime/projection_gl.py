"""Projection, culling and depth order of Gaussians that lie on an OpenGL device.

A fragment for each Gaussian projects it, in float32. Their order is the CPU's radix sort of depths in float64 (in
float32 neighbours change places), so means are what crosses: 16 bytes a Gaussian come back, 4 go up again, and the
device waits for them. A bitonic sort in fragment
passes would keep them there; for 32 768 Gaussians it is 120 passes, each a call from Python, so it is not what is done.
"""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np
from numba import njit

from ._raster_project import view_of
from ._raster_tiles import _front_to_back
from .camera import Camera
from .gl_passes import GaussianTargets, GaussianTexture, Pass
from .surfaces_gl import Surfaces

_EVERYTHING = -2.0  # least n·v where nothing is culled


class Projected(NamedTuple):
    """What splat.vert reads of V drawn Gaussians among N."""

    order: moderngl.Texture  # of each rank, back to front
    places: moderngl.Texture  # by Gaussian
    shapes: moderngl.Texture
    ranks: int  # V

    def textures(self) -> dict[str, moderngl.Texture]:
        """By the names of their samplers."""
        return {"order": self.order, "places": self.places, "shapes": self.shapes}


class GlProjection:
    """Projects Gaussians for a camera; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._targets = GaussianTargets(context, (4, 4, 4))
        self._order = GaussianTexture(context, 1, dtype="i4")
        self._pass = Pass(context, ("fill.vert",), ("project.frag",))

    def project(self, surfaces: Surfaces, camera: Camera, cull: float | None) -> Projected:
        """All of ``surfaces`` that can be seen, but those whose n·v is below ``cull``."""
        count = surfaces.gaussians
        (places, shapes, _), target = self._targets.reserve(count)
        view = view_of(camera)
        self._pass.bind(
            surfaces.textures(),
            count=count,
            axes=view.rotation,  # by column its rows, the camera's axes
            translation=view.translation,
            eye=camera.position,
            pinhole=(view.fx, view.fy, view.cx, view.cy),
            slopes=(view.low_x, view.low_y, view.high_x, view.high_y),
            size=(view.width, view.height),
            facing=_EVERYTHING if cull is None else cull,
        )
        self._context.enable_only(moderngl.NOTHING)
        self._pass.fill()
        drawn = np.empty((*target.viewport[2:][::-1], 4), np.float32)
        target.read_into(drawn, viewport=target.viewport, components=4, attachment=2, dtype="f4")
        order = _back_to_front(drawn.reshape(-1, 4)[:count], view.rotation[2])
        return Projected(self._order.write(order), places, shapes, len(order))

    def release(self) -> None:
        for part in (self._targets, self._order, self._pass):
            part.release()


@njit(error_model="numpy", nogil=True, cache=True)
def _back_to_front(drawn, forward):  # type: ignore[no-untyped-def]
    """Indices [V] by how far means lie along ``forward`` of those whose fourth number is positive; equal ones by
    falling index."""
    count = len(drawn)
    depths, starts = np.empty(count, np.float64), np.zeros(count + 1, np.int64)
    for i in range(count):
        depths[i] = forward[0] * drawn[i, 0] + forward[1] * drawn[i, 1] + forward[2] * drawn[i, 2]
        starts[i + 1] = starts[i] + (1 if drawn[i, 3] > 0 else 0)
    order = _front_to_back(depths, starts)
    return order[::-1].copy()
