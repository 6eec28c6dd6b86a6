"""Projection, culling and depth order of Gaussians on an OpenGL device.

A fragment per Gaussian projects it in float32. Depths are sorted in float64: by compute shaders (``gl.sort``), or by
the CPU's radix sort before OpenGL 4.3 and with software OpenGL. Both give the same order.
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

_EVERYTHING = -2.0  # min n·v without culling


class Projected(NamedTuple):
    """Input of splat.vert for N Gaussians."""

    order: moderngl.Texture  # Gaussian of each rank, back to front; −1 for none
    positions: moderngl.Texture  # by Gaussian
    shapes: moderngl.Texture
    ranks: int  # at least the number of rendered Gaussians

    def textures(self) -> dict[str, moderngl.Texture]:
        """By the names of their samplers."""
        return {"order": self.order, "places": self.positions, "shapes": self.shapes}


class GlProjection:
    """Projects Gaussians for a camera; the context must be current.

    Args:
        sorting: "cpu", "device" or "auto": the device, unless it is software or its compute shaders fail to compile.

    Raises:
        InputError: sorting on the device is requested and not possible.
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
        """Project visible Gaussians, except those with n·v below ``cull``."""
        count = surfaces.gaussians
        (positions, shapes, centres), target = self._targets.reserve(count)
        view = pinhole(camera)
        self._pass.bind(
            surfaces.textures(),
            count=count,
            axes=view.rotation,  # uploaded by column, which transposes it
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
            return Projected(self._sort.order(centres, count, view.rotation[2]), positions, shapes, count)
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
    """The device's sort as chosen by ``sorting``; None for the CPU's."""
    if sorting == "cpu" or (sorting == "auto" and (is_software(context) or not can_sort(context))):
        return None
    try:
        return DepthSort(context)
    except InputError:  # the driver has compute shaders and does not compile these
        if sorting == "device":
            raise
        return None


@njit(error_model="numpy", nogil=True, cache=True)
def _back_to_front(means, forward):  # type: ignore[no-untyped-def]
    """Indices [V] of Gaussians with ``means[:, 3]`` > 0 by falling depth along ``forward``, then falling index."""
    count = len(means)
    depths, starts = np.empty(count, np.float64), np.zeros(count + 1, np.int64)
    for i in range(count):
        depths[i] = forward[0] * means[i, 0] + forward[1] * means[i, 1] + forward[2] * means[i, 2]
        starts[i + 1] = starts[i] + (1 if means[i, 3] > 0 else 0)
    order = front_to_back(depths, starts)
    return order[::-1].copy()
