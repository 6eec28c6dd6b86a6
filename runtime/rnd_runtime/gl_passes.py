"""What passes over Gaussians share: textures with some texels for each of them, and programs put together from parts.

A fragment stands for a Gaussian: Gaussian i is texel (i % ROW_GAUSSIANS, i // ROW_GAUSSIANS), and where it has several
texels they lie side by side.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

ROW_GAUSSIANS = 1024  # Gaussians in a row of a texture


class GaussianTexture:
    """A texture that grows with the number of Gaussians; its context must be current whenever it is used.

    Args:
        context: where it lives.
        components: numbers in a texel.
        texels: for each Gaussian.
        dtype: "f4" or "i4".
    """

    def __init__(
        self, context: moderngl.Context, components: int, *, texels: int = 1, dtype: str = "f4"
    ) -> None:
        self._context, self._components, self._texels, self._dtype = context, components, texels, dtype
        self._texture: moderngl.Texture | None = None

    def reserve(self, count: int) -> moderngl.Texture:
        """The texture, with room for ``count`` Gaussians; what it held is lost when it grows."""
        rows = max(-(-count // ROW_GAUSSIANS), 1)
        if self._texture is None or self._texture.height < rows:
            self.release()
            size = (ROW_GAUSSIANS * self._texels, rows)
            self._texture = self._context.texture(size, self._components, dtype=self._dtype)
            self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return self._texture

    def write(self, values: NDArray[Any]) -> moderngl.Texture:
        """Upload ``values`` [N, texels · components], contiguous and of the texture's type."""
        texture = self.reserve(len(values))
        whole, rest = divmod(len(values), ROW_GAUSSIANS)
        if whole:
            texture.write(
                values[: whole * ROW_GAUSSIANS], viewport=(0, 0, ROW_GAUSSIANS * self._texels, whole)
            )
        if rest:
            texture.write(values[whole * ROW_GAUSSIANS :], viewport=(0, whole, rest * self._texels, 1))
        return texture

    def release(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None


class Pass:
    """A program without vertex arrays: its vertex shader makes everything of ``gl_VertexID``.

    Args:
        context: current now.
        vertex, fragment: names of the files in ``shaders`` that make up either shader, in this order.
        macros: what the shaders ask to be defined, beside ROW_GAUSSIANS.
    """

    def __init__(
        self,
        context: moderngl.Context,
        vertex: tuple[str, ...],
        fragment: tuple[str, ...],
        macros: Mapping[str, object] | None = None,
    ) -> None:
        head = shader_head({"ROW_GAUSSIANS": ROW_GAUSSIANS, **(macros or {})})
        self._program = context.program(
            vertex_shader=head + _source(vertex), fragment_shader=head + _source(fragment)
        )
        self._vertices = context.vertex_array(self._program, [])
        self._uniforms: dict[str, Any] = {name: self._program[name] for name in self._program}

    def bind(self, textures: Mapping[str, moderngl.Texture], **uniforms: Any) -> None:
        """Textures by the names of their samplers; uniforms as int, or as arrays of float32 (matrices by column).

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

    def fill(self, framebuffer: moderngl.Framebuffer, count: int) -> None:
        """Run the fragment shader for the texels of ``count`` Gaussians, and for the rest of their last row."""
        framebuffer.viewport = (0, 0, ROW_GAUSSIANS, -(-count // ROW_GAUSSIANS))
        framebuffer.use()
        self.render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        self._vertices.release()
        self._program.release()


def shader_head(macros: Mapping[str, object]) -> str:
    """GLSL's version and the macros that the shaders ask for."""
    return "#version 330 core\n" + "".join(f"#define {name} {value}\n" for name, value in macros.items())


def _source(names: tuple[str, ...]) -> str:
    folder = resources.files(__package__) / "shaders"
    return "\n".join((folder / name).read_text("utf-8") for name in names)
