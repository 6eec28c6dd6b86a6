"""Projection, culling and depth order of Gaussians that lie on an OpenGL device.

A fragment for each Gaussian projects it, in float32. Their order is that of depths in float64, by compute shaders
(``gl.sort``). Without them (OpenGL before 4.3, so all of macOS), and where OpenGL runs on the CPU, the CPU's radix sort
does it. Both give the same order.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import moderngl
import numpy as np
from numba import njit

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.raster.project import pinhole
from rnd_runtime.raster.tiles import front_to_back

from .context import is_software
from .passes import GaussianTargets, GaussianTexture, Pass
from .sort import DepthSort, can_sort
from .surfaces import Surfaces

Sorting = Literal["auto", "cpu", "device"]

_EVERYTHING = -2.0  # least n·v where nothing is culled


class Projected(NamedTuple):
    """What splat.vert reads of N Gaussians."""

    order: moderngl.Texture  # of each rank, back to front; −1 where there is none
    positions: moderngl.Texture  # by Gaussian
    shapes: moderngl.Texture
    ranks: int  # at least as many as are rendered

    def textures(self) -> dict[str, moderngl.Texture]:
        """By the names of their samplers."""
        return {"order": self.order, "places": self.positions, "shapes": self.shapes}


class GlProjection:
    """Projects Gaussians for a camera; the context must be current.

    Args:
        context: where.
        sorting: by the "cpu", by the "device", or by the device unless it is the CPU or has no compute shaders that
            its driver compiles ("auto").

    Raises:
        InputError: the device shall sort and cannot.
    """

    def __init__(self, context: moderngl.Context, sorting: Sorting = "auto") -> None:
        if sorting not in get_args(Sorting):
            raise InputError("sorting", expected=" | ".join(get_args(Sorting)), got=repr(sorting))
        self._context = context
        self._targets = GaussianTargets(context, (4, 4, 4))
        self._pass = Pass(context, ("fill.vert",), ("project.frag",))
        self._sort = _device_sort(context, sorting)
        self._order = GaussianTexture(context, 1, dtype="i4") if self._sort is None else None

    def project(self, surfaces: Surfaces, camera: Camera, cull: float | None) -> Projected:
        """All of ``surfaces`` that can be seen, but those whose n·v is below ``cull``."""
        count = surfaces.gaussians
        (positions, shapes, drawn), target = self._targets.reserve(count)
        view = pinhole(camera)
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
        if self._sort is not None:
            return Projected(self._sort.order(drawn, count, view.rotation[2]), positions, shapes, count)
        assert self._order is not None
        means = np.empty((*target.viewport[2:][::-1], 4), np.float32)
        target.read_into(means, viewport=target.viewport, components=4, attachment=2, dtype="f4")
        order = _back_to_front(means.reshape(-1, 4)[:count], view.rotation[2])
        return Projected(self._order.write(order), positions, shapes, len(order))

    def release(self) -> None:
        for part in (self._targets, self._pass, self._sort, self._order):
            if part is not None:
                part.release()


def _device_sort(context: moderngl.Context, sorting: Sorting) -> DepthSort | None:
    """Compute shaders that sort, where they are asked for, or are there and worth it; None: the CPU sorts."""
    if sorting == "cpu" or (sorting == "auto" and (is_software(context) or not can_sort(context))):
        return None
    try:
        return DepthSort(context)
    except InputError:  # the driver promises compute shaders and does not compile these
        if sorting == "device":
            raise
        return None


@njit(error_model="numpy", nogil=True, cache=True)
def _back_to_front(drawn, forward):  # type: ignore[no-untyped-def]
    """Indices [V] by how far means lie along ``forward`` of those whose fourth number is positive; equal ones by
    falling index."""
    count = len(drawn)
    depths, starts = np.empty(count, np.float64), np.zeros(count + 1, np.int64)
    for i in range(count):
        depths[i] = forward[0] * drawn[i, 0] + forward[1] * drawn[i, 1] + forward[2] * drawn[i, 2]
        starts[i + 1] = starts[i] + (1 if drawn[i, 3] > 0 else 0)
    order = front_to_back(depths, starts)
    return order[::-1].copy()
