"""Frames rendered on an OpenGL device: posing, projection, shading, splatting, tone mapping.

Only network outputs are uploaded and images read back, where the device can sort.
"""

from __future__ import annotations

from time import perf_counter

import moderngl
import numpy as np

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians, Raster
from rnd_runtime.posing.rest import Unposed
from rnd_runtime.shading.shader import Shader

from .finish import GlFinish
from .passes import Pass
from .posing import GlPosing
from .projection import GlProjection, Sorting
from .raster import GlRasterizer, splat_pass
from .shading import GlShading
from .surfaces import SurfaceUpload

RADIANCE = 3  # attributes of the splats


class GlRenderer:
    """Renders an avatar under a light; keeps programs, tables and textures between calls.

    Args:
        rasterizer: provides context and targets; close it after this.
        sorting: see ``gl.projection.GlProjection``.
    """

    def __init__(self, rasterizer: GlRasterizer, sorting: Sorting = "auto") -> None:
        self._rasterizer, self._sorting = rasterizer, sorting
        self._passes: _Passes | None = None

    def draw(self, body: Gaussians | Unposed, shader: Shader, camera: Camera, *, cull: float | None = None) -> Raster:
        """Render linear radiance [H, W, 3] with sharpened outlines, without depth.

        Args:
            body: posed Gaussians, or those to be posed on the device.
            cull: as in ``playback.frame.FrameRenderer``; culled Gaussians still cast shadows.

        Returns:
            The raster; ``seconds`` has "posing" or "upload", "projection+sort", "shading", "raster" and "read-back",
            each until the device has finished.

        Raises:
            InputError: an array has the wrong shape or exceeds a limit of GL.
        """
        self._rasterizer.check_limits(len(body.opacities), camera)
        with self._rasterizer.context as context:
            if self._passes is None:
                self._passes = _Passes(context, self._sorting)
            seconds = self._draw(context, self._passes, body, shader, camera, cull)
            started = perf_counter()
            result = self._passes.finish.read(camera)
            seconds["read-back"] = perf_counter() - started
        return Raster(result.image, result.alpha, np.zeros_like(result.alpha), seconds, result.srgb)

    def close(self) -> None:
        """Release everything but the rasteriser."""
        if self._passes is not None:
            with self._rasterizer.context:
                self._passes.release()
            self._passes = None

    def _draw(
        self,
        context: moderngl.Context,
        passes: _Passes,
        body: Gaussians | Unposed,
        shader: Shader,
        camera: Camera,
        cull: float | None,
    ) -> dict[str, float]:
        seconds: dict[str, float] = {}
        started = perf_counter()

        def finished(stage: str) -> None:
            nonlocal started
            context.finish()
            seconds[stage] = perf_counter() - started
            started = perf_counter()

        if isinstance(body, Unposed):
            surfaces = passes.posing.pose(body)
            finished("posing")
        else:
            surfaces = passes.upload.write(body)
            finished("upload")
        textures, ranks = {}, 0
        if surfaces.gaussians:
            projected = passes.projection.project(surfaces, camera, cull)
            textures, ranks = projected.textures(), projected.ranks
        finished("projection+sort")
        if ranks:
            textures["radiance"] = passes.shading.shade(
                shader, surfaces, projected.order, ranks, camera.position, body.root_rotation
            )
        finished("shading")
        self._rasterizer.blend(passes.splat, textures, ranks, RADIANCE, camera)
        passes.finish.run(self._rasterizer.targets_for(RADIANCE, camera).textures[0], camera)
        finished("raster")
        return seconds


class _Passes:
    """All objects on the device."""

    def __init__(self, context: moderngl.Context, sorting: Sorting) -> None:
        self.posing, self.upload = GlPosing(context), SurfaceUpload(context)
        self.projection, self.shading = GlProjection(context, sorting), GlShading(context)
        self.splat: Pass = splat_pass(context, RADIANCE, lit=True)
        self.finish = GlFinish(context)

    def release(self) -> None:
        for part in (self.posing, self.upload, self.projection, self.shading, self.splat, self.finish):
            part.release()
