"""Finishing of a blended image on the device: outlines, tone mapping, packing.

Images are read back as contiguous RGB arrays, so the CPU need not repack them.
"""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.raster.tone import code_steps

from .context import is_software
from .passes import Pass, Targets

CHANNELS, PACKED = 3, 4  # of a pixel; numbers in a texel


class Finished(NamedTuple):
    """image [H, W, 3] linear, premultiplied; alpha [H, W]; srgb [H, W, 3] 8-bit over black, or None."""

    image: Floats32
    alpha: Floats32
    srgb: NDArray[np.uint8] | None


class GlFinish:
    """Finishes images of three channels; the context must be current.

    Args:
        tone: make 8-bit images too, to the bit as ``raster.tone.tone_map``; by default on GPUs, as the CPU is faster
            than software OpenGL.
    """

    def __init__(self, context: moderngl.Context, tone: bool | None = None) -> None:
        self._context = context
        self._tone = not is_software(context) if tone is None else tone
        macros = {"TONE": 1} if self._tone else {}
        self._pass = Pass(context, ("fill.vert",), ("finish.glsl", "finish.frag"), macros)
        self._alpha_pass = Pass(context, ("fill.vert",), ("finish.glsl", "finish_alpha.frag"))
        self._steps = context.texture((len(code_steps()), 1), 1, code_steps().tobytes(), dtype="f4")
        self._steps.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._targets: tuple[Targets, Targets] | None = None

    def run(self, blended: moderngl.Texture, camera: Camera) -> None:
        """Finish ``blended``, a texture of the camera's size: premultiplied radiance and alpha."""
        packed, alpha = (targets.framebuffer for targets in self._targets_for(camera))
        self._context.enable_only(moderngl.NOTHING)
        packed.use()
        self._pass.bind({"blended": blended, "steps": self._steps}, width=camera.width)
        self._pass.fill()
        alpha.use()
        self._alpha_pass.bind({"blended": blended})
        self._alpha_pass.fill()

    def read(self, camera: Camera) -> Finished:
        """The result of ``run`` for ``camera``."""
        packed, coverage = (targets.framebuffer for targets in self._targets_for(camera))
        alpha = np.empty((camera.height, camera.width), np.float32)
        coverage.read_into(alpha, components=1, dtype="f4", alignment=1)
        rows = (camera.height, PACKED * _texels(camera.width))
        image, srgb = np.empty(rows, np.float32), np.empty(rows, np.uint8)
        packed.read_into(image, components=PACKED, dtype="f4", alignment=1)
        if self._tone:
            packed.read_into(srgb, components=PACKED, attachment=1, dtype="f1", alignment=1)
        return Finished(_unpacked(image, camera), alpha, _unpacked(srgb, camera) if self._tone else None)

    def release(self) -> None:
        self._pass.release()
        self._alpha_pass.release()
        self._steps.release()
        for targets in self._targets or ():
            targets.release()
        self._targets = None

    def _targets_for(self, camera: Camera) -> tuple[Targets, Targets]:
        """Targets of packed numbers, and of alpha; those of another size are released."""
        size, old = (camera.width, camera.height), self._targets
        if old is None or old[1].framebuffer.size != size:
            packed, texture = (_texels(camera.width), camera.height), self._context.texture
            textures = [texture(packed, PACKED, dtype=dtype) for dtype in ("f4", "f1")[: 1 + self._tone]]
            coverage = [texture(size, 1, dtype="f4")]
            self._targets = Targets.of(self._context, textures), Targets.of(self._context, coverage)
            for targets in old or ():
                targets.release()  # only now: on making a framebuffer moderngl rebinds the one in use
        assert self._targets is not None
        return self._targets


def _texels(width: int) -> int:
    """Texels of a packed row of ``width`` pixels."""
    return -(-CHANNELS * width // PACKED)


def _unpacked(rows: NDArray, camera: Camera) -> NDArray:  # type: ignore[type-arg]
    """[H, 4 · texels] → [H, W, 3]; a view where rows are not padded."""
    exact = rows[:, : CHANNELS * camera.width]
    return np.ascontiguousarray(exact).reshape(camera.height, camera.width, CHANNELS)
