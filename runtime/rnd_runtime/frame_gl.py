"""Shading and splatting on the device: posed Gaussians go up, the picture comes back, nothing crosses in between."""

from __future__ import annotations

from time import perf_counter

import moderngl
import numpy as np
from numba import njit

from ._raster_input import checked
from ._raster_project import view_of
from .camera import Camera
from .gaussians import Floats32, Gaussians, Raster
from .gl_passes import GaussianTexture, Pass
from .raster_gl import LOG2_255, Ellipses, GlRasterizer, sorted_ellipses, splat_pass
from .shading import Shader
from .shading_gl import GlShading, SurfaceUpload

RADIANCE = 3  # attributes that the splats carry


class GlRenderer:
    """Draws Gaussians under a light; keeps programs, tables and textures between calls.

    Projection, culling and depth order are the CPU's, as :class:`rnd_runtime.raster_gl.GlRasterizer` has them. Every
    stage's time ends when the device has finished it.

    Args:
        rasterizer: whose context and targets are drawn with; to be closed after this.
    """

    def __init__(self, rasterizer: GlRasterizer) -> None:
        self._rasterizer = rasterizer
        context = rasterizer.context
        self._upload, self._shading = SurfaceUpload(context), GlShading(context)
        self._order = GaussianTexture(context, 1, dtype="i4")
        self._places, self._shapes = GaussianTexture(context, 4), GaussianTexture(context, 4)
        self._splat: Pass | None = None

    def draw(self, gaussians: Gaussians, opacities: Floats32, shader: Shader, camera: Camera) -> Raster:
        """The picture's linear radiance [H, W, 3], without depth; only Gaussians that reach it are shaded.

        ``opacities`` [N] are those to splat with; shadows are cast by the Gaussians' own.

        Raises:
            InputError: an array has the wrong shape, or there is more than GL can hold.
        """
        nothing = np.empty((len(gaussians.means), 0), np.float32)
        arrays = checked(gaussians.means, gaussians.covariances, opacities, nothing)
        self._rasterizer.check_limits(len(nothing), camera)
        started = perf_counter()
        ellipses = sorted_ellipses(*arrays, view_of(camera))
        seconds = {"projection+sort": perf_counter() - started}
        with self._rasterizer.context as context:
            seconds |= self._draw(context, gaussians, ellipses, shader, camera)
            started = perf_counter()
            (picture,) = self._rasterizer.read(RADIANCE, camera)
            seconds["read-back"] = perf_counter() - started
        alpha = picture[..., 3]
        return Raster(picture[..., :3], alpha, np.zeros_like(alpha), seconds)

    def close(self) -> None:
        """Release everything but the rasteriser."""
        with self._rasterizer.context:
            for part in (self._upload, self._shading, self._order, self._places, self._shapes, self._splat):
                if part is not None:
                    part.release()
        self._splat = None

    def _draw(
        self,
        context: moderngl.Context,
        gaussians: Gaussians,
        ellipses: Ellipses,
        shader: Shader,
        camera: Camera,
    ) -> dict[str, float]:
        seconds = {}
        textures: dict[str, moderngl.Texture] = {}
        ranks = len(ellipses.order)
        if ranks:
            started = perf_counter()
            surfaces = self._upload.write(gaussians)
            textures = self._ellipses(ellipses)
            context.finish()
            uploaded = perf_counter()
            textures["radiance"] = self._shading.shade(
                shader, surfaces, textures["order"], ranks, camera.position, gaussians.root_rotation
            )
            context.finish()
            seconds = {"upload": uploaded - started, "shading": perf_counter() - uploaded}
        if self._splat is None:
            self._splat = splat_pass(context, RADIANCE, lit=True)
        started = perf_counter()
        self._rasterizer.blend(self._splat, textures, ranks, RADIANCE, camera)
        context.finish()
        return {**seconds, "raster": perf_counter() - started}

    def _ellipses(self, ellipses: Ellipses) -> dict[str, moderngl.Texture]:
        count = len(ellipses.centers)
        places, shapes = np.empty((count, 4), np.float32), np.empty((count, 4), np.float32)
        _fill(ellipses.order, ellipses.centers, ellipses.shapes, places, shapes)
        return {
            "order": self._order.write(np.ascontiguousarray(ellipses.order[::-1])),
            "places": self._places.write(places),
            "shapes": self._shapes.write(shapes),
        }


@njit(error_model="numpy", nogil=True, cache=True)
def _fill(order, centers, forms, places, shapes):  # type: ignore[no-untyped-def]
    """Rows of the drawn Gaussians as splat.vert reads them."""
    for i in order:
        shear, fall_y, fall_x, peak = forms[i, 0], forms[i, 1], forms[i, 2], forms[i, 3]
        places[i, 0], places[i, 1] = centers[i, 0], centers[i, 1]
        places[i, 2], places[i, 3] = np.sqrt(max(peak + LOG2_255, 0.0)), peak
        shapes[i, 0], shapes[i, 1], shapes[i, 2], shapes[i, 3] = np.sqrt(fall_x), np.sqrt(fall_y), shear, 0.0
