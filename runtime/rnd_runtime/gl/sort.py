"""Depth order of Gaussians by compute shaders.

A stable radix sort (8 bits per pass) of the float64 keys of ``raster.tiles``: the order is the CPU's. Blocks count
digits, one group scans the counts, blocks scatter.

Source: Satish, Harris, Garland, "Designing efficient sorting algorithms for manycore GPUs" (2009).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError

from .context import COMPUTE_VERSION
from .passes import ROW_GAUSSIANS, GaussianTexture, shader_head, shader_source

_BLOCK = 1024  # keys per group of 256 threads
_THREADS = 256
_RANGE_THREADS = 1024  # GL's guaranteed minimum per group
_PASSES = 4  # of eight bits

_RANGE, _KEYS, _GAUSSIANS, _NEW_KEYS, _NEW_GAUSSIANS, _COUNTS = range(6)  # bindings in the shaders


class DepthSort:
    """Orders Gaussians back to front; the context must be current.

    Raises:
        InputError: the context has no compute shaders, or its driver does not compile them.
    """

    def __init__(self, context: moderngl.Context) -> None:
        if not can_sort(context):
            expected = f"OpenGL {COMPUTE_VERSION // 100}.{COMPUTE_VERSION // 10 % 10}"
            raise InputError("sorting on the device", expected=expected, got=context.version_code)
        self._context = context
        radix = ("radix.glsl", "radix_scatter.comp")
        self._programs = {
            "range": _program(context, ("depth.glsl", "depth_range.comp"), {"THREADS": _RANGE_THREADS}),
            "keys": _program(context, ("depth.glsl", "depth_keys.comp"), {"THREADS": _THREADS}),
            "count": _program(context, ("radix.glsl", "radix_count.comp")),
            "scan": _program(context, ("radix_scan.comp",)),
            "scatter": _program(context, radix),
            "finish": _program(context, radix, {"LAST_PASS": 1}),  # into the texture
        }
        self._order = GaussianTexture(context, 1, dtype="i4")
        self._extremes = context.buffer(reserve=16)
        self._capacity = 0  # of the buffers, blocks
        self._buffers: dict[int, moderngl.Buffer] = {}

    def order(self, drawn: moderngl.Texture, count: int, forward: NDArray[np.float64]) -> moderngl.Texture:
        """Gaussian of each of ``count`` ranks, back to front; −1 for those not rendered.

        Args:
            drawn: a texel per Gaussian: mean m, and a positive number where it is rendered.
            forward: [3] depth direction in the means' frame.
        """
        blocks = -(-count // _BLOCK)
        self._reserve(blocks)
        order = self._order.reserve(count)
        self._extremes.bind_to_storage_buffer(_RANGE)
        self._buffers[_COUNTS].bind_to_storage_buffer(_COUNTS)
        order.bind_to_image(0, read=False, write=True)
        drawn.use(0)
        depths = {"drawn": 0, "count": count, "forward": tuple(float(x) for x in forward)}
        self._bind(_KEYS, _GAUSSIANS)
        self._run("range", 1, **depths)
        self._run("keys", -(-count // _THREADS), **depths)
        read, write = (_KEYS, _GAUSSIANS), (_NEW_KEYS, _NEW_GAUSSIANS)
        for digit in range(_PASSES):
            self._bind(*read, *write)
            self._run("count", blocks, count=count, shift=8 * digit)
            self._run("scan", 1, blocks=blocks)
            self._run("scatter" if digit < _PASSES - 1 else "finish", blocks, count=count, shift=8 * digit)
            read, write = write, read
        return order

    def release(self) -> None:
        for program in self._programs.values():
            program.release()
        for buffer in (*self._buffers.values(), self._extremes):
            buffer.release()
        self._buffers = {}
        self._order.release()

    def _reserve(self, blocks: int) -> None:
        if blocks <= self._capacity:
            return
        for buffer in self._buffers.values():
            buffer.release()
        sizes = dict.fromkeys((_KEYS, _GAUSSIANS, _NEW_KEYS, _NEW_GAUSSIANS), 4 * _BLOCK * blocks)
        sizes[_COUNTS] = 4 * 256 * blocks
        self._buffers = {name: self._context.buffer(reserve=size) for name, size in sizes.items()}
        self._capacity = blocks

    def _bind(self, *names: int) -> None:
        """Bind buffers to consecutive bindings from ``_KEYS`` on."""
        for binding, name in enumerate(names, start=_KEYS):
            self._buffers[name].bind_to_storage_buffer(binding)

    def _run(self, name: str, groups: int, **uniforms: Any) -> None:
        program = self._programs[name]
        for uniform, value in uniforms.items():
            program[uniform].value = value
        program.run(groups)
        self._context.memory_barrier()


def can_sort(context: moderngl.Context) -> bool:
    """Whether the context has compute shaders."""
    return context.version_code >= COMPUTE_VERSION


def _program(
    context: moderngl.Context, names: tuple[str, ...], macros: Mapping[str, Any] | None = None
) -> moderngl.ComputeShader:
    head = shader_head({"ROW_GAUSSIANS": ROW_GAUSSIANS, "BLOCK": _BLOCK, **(macros or {})}, version=COMPUTE_VERSION)
    try:
        return context.compute_shader(head + shader_source(names))
    except moderngl.Error as error:
        raise InputError(
            "sorting on the device", expected=f"a driver that compiles {names[-1]}", got=" ".join(str(error).split())
        ) from error
