"""Choice between the OpenGL and the CPU rasteriser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.raster import cpu as raster_cpu

if TYPE_CHECKING:  # importing OpenGL takes 1/20 of a start
    from rnd_runtime.gl.context import Backend
    from rnd_runtime.gl.frame import GlRenderer
    from rnd_runtime.gl.raster import GlRasterizer

Kind = Literal["auto", "gl", "gl-egl", "gl-osmesa", "cpu"]


class ChosenRasterizer:
    """A ``core.gaussians.Rasterizer`` with a name; a context manager.

    Attributes:
        name: such as ``gl (egl, llvmpipe (LLVM 15.0.6, 256 bits))`` or ``cpu``.
        renderer: renders complete frames on the device; None for the CPU.
    """

    def __init__(self, name: str, gl: GlRasterizer | None = None) -> None:
        self.name = name
        self._gl = gl
        self._rasterize = raster_cpu.rasterize if gl is None else gl
        self.renderer: GlRenderer | None = None
        if gl is not None:
            from rnd_runtime.gl.frame import GlRenderer

            self.renderer = GlRenderer(gl)

    def __call__(
        self,
        means: Floats32,
        covariances: Floats32,
        opacities: Floats32,
        features: Floats32,
        camera: Camera,
        *,
        depth: bool = True,
    ) -> Raster:
        return self._rasterize(means, covariances, opacities, features, camera, depth=depth)

    def close(self) -> None:
        if self.renderer is not None:
            self.renderer.close()
        if self._gl is not None:
            self._gl.close()

    def __enter__(self) -> ChosenRasterizer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def make_rasterizer(kind: Kind = "auto") -> ChosenRasterizer:
    """Make the rasteriser ``kind``.

    Args:
        kind: "auto" is OpenGL on a GPU, else the CPU kernel, which is five to seven times as fast as software OpenGL.
            "gl-egl" and "gl-osmesa" name the backend; "gl" takes the first that works.

    Raises:
        InputError: "gl" without OpenGL, or another kind.
    """
    if kind not in get_args(Kind):
        raise InputError("rasteriser", expected=" | ".join(get_args(Kind)), got=repr(kind))
    if kind == "cpu":
        return ChosenRasterizer("cpu")
    from rnd_runtime.gl.context import create_context, is_software, renderer
    from rnd_runtime.gl.raster import GlRasterizer

    backends: dict[str, Backend] = {"gl-egl": "egl", "gl-osmesa": "osmesa"}
    try:
        context = create_context(backends.get(kind, "auto"))
    except InputError:
        if kind != "auto":
            raise
        return ChosenRasterizer("cpu")
    if kind == "auto" and is_software(context):
        context.release()
        return ChosenRasterizer("cpu")
    name = f"gl ({context.extra.backend}, {renderer(context)})"
    return ChosenRasterizer(name, GlRasterizer(context=context))
