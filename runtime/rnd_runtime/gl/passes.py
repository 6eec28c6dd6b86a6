"""Textures with some texels per Gaussian, and shader programs assembled from files.

Gaussian i is texel (i % ROW_GAUSSIANS, i // ROW_GAUSSIANS); several texels of one are adjacent. With many texels
ROW_WIDE Gaussians make a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from .constants import shared_constants
from .context import GL_VERSION

ROW_GAUSSIANS = 1024  # Gaussians in a row of a texture
ROW_WIDE = 256  # Gaussians or nodes of many texels in a row; GL guarantees 1024 texels, drivers have 16384


class GaussianTexture:
    """A texture that grows with the number of Gaussians; the context must be current.

    Args:
        components: numbers per texel.
        texels: per Gaussian.
        dtype: "f4" or "i4".
        row: Gaussians per row.
    """

    def __init__(
        self,
        context: moderngl.Context,
        components: int,
        *,
        texels: int = 1,
        dtype: str = "f4",
        row: int = ROW_GAUSSIANS,
    ) -> None:
        self._context, self._components, self._texels, self._dtype = context, components, texels, dtype
        self._row = row
        self._texture: moderngl.Texture | None = None

    def reserve(self, count: int) -> moderngl.Texture:
        """The texture with capacity for ``count`` Gaussians; growth discards its content."""
        rows = max(-(-count // self._row), 1)
        if self._texture is None or self._texture.height < rows:
            self.release()
            size = (self._row * self._texels, rows)
            self._texture = self._context.texture(size, self._components, dtype=self._dtype)
            self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return self._texture

    def write(self, values: NDArray[Any]) -> moderngl.Texture:
        """Upload ``values`` [N, texels · components], contiguous and of the texture's type."""
        texture = self.reserve(len(values))
        full_rows, rest = divmod(len(values), self._row)
        if full_rows:
            texture.write(values[: full_rows * self._row], viewport=(0, 0, self._row * self._texels, full_rows))
        if rest:
            texture.write(values[full_rows * self._row :], viewport=(0, full_rows, rest * self._texels, 1))
        return texture

    def release(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None


class GaussianTargets:
    """Float32 textures as targets of one pass, each with its ``components`` and the same texels per Gaussian."""

    def __init__(self, context: moderngl.Context, components: tuple[int, ...], *, texels: int = 1) -> None:
        self._context, self._texels = context, texels
        self._textures = [GaussianTexture(context, count, texels=texels) for count in components]
        self._made: tuple[list[moderngl.Texture], moderngl.Framebuffer] | None = None

    def reserve(self, count: int) -> tuple[list[moderngl.Texture], moderngl.Framebuffer]:
        """The textures and their framebuffer, bound, with a viewport of the rows of ``count`` Gaussians."""
        old, textures = self._made, [texture.reserve(count) for texture in self._textures]
        if old is None or old[0][0] is not textures[0]:
            self._made = textures, self._context.framebuffer(textures)
        assert self._made is not None
        framebuffer = self._made[1]
        framebuffer.viewport = (0, 0, ROW_GAUSSIANS * self._texels, -(-count // ROW_GAUSSIANS))
        framebuffer.use()
        if old is not None and old is not self._made:
            old[1].release()  # only now: on making a framebuffer moderngl rebinds the one in use
        return self._made

    def release(self) -> None:
        if self._made is not None:
            self._made[1].release()
            self._made = None
        for texture in self._textures:
            texture.release()


class Targets(NamedTuple):
    """Textures of one size as targets of a pass, and their framebuffer."""

    textures: list[moderngl.Texture]
    framebuffer: moderngl.Framebuffer

    @classmethod
    def of(cls, context: moderngl.Context, textures: list[moderngl.Texture]) -> Targets:
        return cls(textures, context.framebuffer(textures))

    def release(self) -> None:
        self.framebuffer.release()
        for texture in self.textures:
            texture.release()


class Pass:
    """A program without vertex arrays, driven by ``gl_VertexID``.

    Args:
        context: current now.
        vertex, fragment: file names in ``shaders`` that make up each shader, in order.
        macros: definitions for the shaders, besides ROW_GAUSSIANS and ROW_WIDE.
    """

    def __init__(
        self,
        context: moderngl.Context,
        vertex: tuple[str, ...],
        fragment: tuple[str, ...],
        macros: Mapping[str, object] | None = None,
    ) -> None:
        head = shader_head({"ROW_GAUSSIANS": ROW_GAUSSIANS, "ROW_WIDE": ROW_WIDE, **(macros or {})})
        self._program = context.program(
            vertex_shader=head + shader_source(vertex), fragment_shader=head + shader_source(fragment)
        )
        self._vertices = context.vertex_array(self._program, [])
        self._uniforms: dict[str, Any] = {name: self._program[name] for name in self._program}

    def bind(self, textures: Mapping[str, moderngl.Texture], **uniforms: Any) -> None:
        """Bind textures by sampler name; uniforms are ints or arrays (matrices by column). Unused names are ignored."""
        for unit, (name, texture) in enumerate(textures.items()):
            if name in self._uniforms:
                texture.use(unit)
                self._uniforms[name].value = unit
        for name, value in uniforms.items():
            if name not in self._uniforms:
                continue
            uniform = self._uniforms[name]
            if isinstance(value, int):
                uniform.value = value
            else:  # the compiler truncates an array to the elements in use
                data = np.ascontiguousarray(value, np.float32).tobytes()
                uniform.write(data[: uniform.array_length * uniform.element_size])

    def render(self, mode: int, vertices: int, *, first: int = 0) -> None:
        self._vertices.render(mode, vertices, first=first)

    def fill(self) -> None:
        """Run the fragment shader for every texel of the bound framebuffer."""
        self.render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        self._vertices.release()
        self._program.release()


def shader_head(macros: Mapping[str, object], *, version: int = GL_VERSION) -> str:
    """GLSL's version, the constants shared with Python, and ``macros``."""
    defined = {**shared_constants(), **macros}
    return f"#version {version} core\n" + "".join(f"#define {name} {value}\n" for name, value in defined.items())


def shader_source(names: tuple[str, ...]) -> str:
    """The named files of ``shaders``, concatenated."""
    folder = resources.files(__package__) / "shaders"
    return "\n".join((folder / name).read_text("utf-8") for name in names)
