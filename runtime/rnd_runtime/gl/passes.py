"""What passes over Gaussians share: textures with some texels for each of them, and programs put together from parts.

A fragment stands for a Gaussian: Gaussian i is texel (i % ROW_GAUSSIANS, i // ROW_GAUSSIANS), and where it has several
texels they lie side by side. Where it has many, ROW_WIDE make a row.
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
ROW_WIDE = 256  # Gaussians, or nodes, of many texels in a row: GL promises no more than 1024 and gives 16384


class GaussianTexture:
    """A texture that grows with the number of Gaussians; its context must be current whenever it is used.

    Args:
        context: where it lives.
        components: numbers in a texel.
        texels: for each Gaussian.
        dtype: "f4" or "i4".
        row: Gaussians in a row.
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
        """The texture, with room for ``count`` Gaussians; what it held is lost when it grows."""
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
    """Float32 textures with the same texels for each Gaussian, of ``components`` each, that one pass draws into."""

    def __init__(self, context: moderngl.Context, components: tuple[int, ...], *, texels: int = 1) -> None:
        self._context, self._texels = context, texels
        self._textures = [GaussianTexture(context, count, texels=texels) for count in components]
        self._made: tuple[list[moderngl.Texture], moderngl.Framebuffer] | None = None

    def reserve(self, count: int) -> tuple[list[moderngl.Texture], moderngl.Framebuffer]:
        """The textures and a framebuffer of them, bound and cut to the rows of ``count`` Gaussians."""
        old, textures = self._made, [texture.reserve(count) for texture in self._textures]
        if old is None or old[0][0] is not textures[0]:
            self._made = textures, self._context.framebuffer(textures)
        assert self._made is not None
        framebuffer = self._made[1]
        framebuffer.viewport = (0, 0, ROW_GAUSSIANS * self._texels, -(-count // ROW_GAUSSIANS))
        framebuffer.use()
        if old is not None and old is not self._made:
            old[1].release()  # only now: moderngl binds the one in use again whenever it makes another
        return self._made

    def release(self) -> None:
        if self._made is not None:
            self._made[1].release()
            self._made = None
        for texture in self._textures:
            texture.release()


class Targets(NamedTuple):
    """Textures of one size that a pass draws into, and the framebuffer of them."""

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
    """A program without vertex arrays: its vertex shader makes everything of ``gl_VertexID``.

    Args:
        context: current now.
        vertex, fragment: names of the files in ``shaders`` that make up either shader, in this order.
        macros: what the shaders ask to be defined, beside ROW_GAUSSIANS and ROW_WIDE.
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
        """Textures by the names of their samplers; uniforms as int, or as arrays of numbers (matrices by column).

        Names that the program does not use are passed over.
        """
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
            else:  # of an array the compiler keeps no more than the program uses
                data = np.ascontiguousarray(value, np.float32).tobytes()
                uniform.write(data[: uniform.array_length * uniform.element_size])

    def render(self, mode: int, vertices: int, *, first: int = 0) -> None:
        self._vertices.render(mode, vertices, first=first)

    def fill(self) -> None:
        """Run the fragment shader for every texel of the framebuffer in use."""
        self.render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        self._vertices.release()
        self._program.release()


def shader_head(macros: Mapping[str, object], *, version: int = GL_VERSION) -> str:
    """GLSL's version, the constants shared with Python, and ``macros``."""
    defined = {**shared_constants(), **macros}
    return f"#version {version} core\n" + "".join(f"#define {name} {value}\n" for name, value in defined.items())


def shader_source(names: tuple[str, ...]) -> str:
    """The files of ``shaders`` by these names, one after the other."""
    folder = resources.files(__package__) / "shaders"
    return "\n".join((folder / name).read_text("utf-8") for name in names)
