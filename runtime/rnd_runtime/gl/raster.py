"""The OpenGL rasteriser: one triangle per Gaussian, blended back to front in float32, any number of channels.

One difference to ``core.gaussians.Rasterizer``'s rule: blending cannot stop at a pixel, so Gaussians beyond a
transmittance of 1e-4 still add less than 0.01 of their features, only where α is near its clamp.

Projection, order and culling are the CPU rasteriser's, in float64. EGL and OSMesa of one Mesa, with any number of
threads, give the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import NamedTuple

import moderngl
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32, checked
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.raster.project import Pinhole, pinhole, project_range
from rnd_runtime.raster.tiles import front_to_back

from .context import Backend, create_context
from .passes import ROW_GAUSSIANS, Pass, Targets

LOG2_255 = float(np.log2(255.0))
GEOMETRY_TEXELS = 2  # centre − image centre, reach, peak; √fall_x, √fall_y, shear, –
PER_TARGET = 3  # attributes per target; the fourth component is α
FLUSHES = 4  # parts of the triangles, so that llvmpipe overlaps setup and filling: 10 % faster


class GlRasterizer:
    """A ``core.gaussians.Rasterizer``; keeps programs and framebuffers between calls.

    Args:
        backend: see ``gl.context.create_context``.
        context: from ``gl.context.create_context``, instead of ``backend``; released by ``close``.

    Raises:
        InputError: no context; arrays of the wrong shape; an image or a number of Gaussians above GL's limits.
    """

    def __init__(self, backend: Backend = "auto", *, context: moderngl.Context | None = None) -> None:
        self.context = create_context(backend) if context is None else context
        self._programs: dict[int, Pass] = {}
        self._targets: dict[tuple[int, int, int], Targets] = {}
        self._records: moderngl.Texture | None = None
        info = self.context.info
        self._max_size = min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"])
        self._max_attributes = PER_TARGET * info["GL_MAX_DRAW_BUFFERS"]

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
        """Splat N Gaussians: means [N, 3] m, covariances [N, 6] m², opacities [N], features [N, C]."""
        means, covariances, opacities, features = checked(means, covariances, opacities, features)
        self.check_limits(len(means), camera)
        channels = features.shape[1]
        started = perf_counter()
        splats = sorted_ellipses(means, covariances, opacities, features, pinhole(camera))
        seconds = {"projection+sort": perf_counter() - started, "raster": 0.0, "read-back": 0.0}
        target_images: list[Floats32] = []  # [H, W, ≤ 4] of every target
        with self.context:
            total = channels + 1 if depth or channels == 0 else channels  # at least one, for α
            for first in range(0, total, self._max_attributes):
                attributes = min(total - first, self._max_attributes)
                started = perf_counter()
                self._draw(splats, first, attributes, camera)
                self.context.finish()  # so that the read-back is timed by itself
                drawn = perf_counter()
                target_images += self.read(attributes, camera)
                seconds["raster"] += drawn - started
                seconds["read-back"] += perf_counter() - drawn
        return _assembled(target_images, channels, depth, seconds)

    def close(self) -> None:
        """Release everything, including the context."""
        with self.context:
            for targets in self._targets.values():
                targets.release()
            for program in self._programs.values():
                program.release()
            if self._records is not None:
                self._records.release()
        self._targets, self._programs, self._records = {}, {}, None
        self.context.release()

    def __enter__(self) -> GlRasterizer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def check_limits(self, count: int, camera: Camera) -> None:
        """Raise an ``InputError`` where the image or the number of Gaussians exceeds GL's limits."""
        size = f"{camera.width} x {camera.height}"
        if max(camera.width, camera.height) > self._max_size:
            raise InputError("image size", expected=f"at most {self._max_size} x {self._max_size}", got=size)
        if count > self._max_size * ROW_GAUSSIANS:
            raise InputError("Gaussians", expected=f"at most {self._max_size * ROW_GAUSSIANS}", got=count)

    def _draw(self, splats: Ellipses, first: int, attributes: int, camera: Camera) -> None:
        """Render attributes ``first`` … ``first + attributes`` of all splats."""
        count = len(splats.order)
        records = self._upload(_records(splats, first, attributes, camera)) if count else None
        if attributes not in self._programs:
            self._programs[attributes] = splat_pass(self.context, attributes)
        self.blend(self._programs[attributes], {"records": records} if records else {}, count, attributes, camera)

    def blend(
        self, splat: Pass, textures: Mapping[str, moderngl.Texture], count: int, attributes: int, camera: Camera
    ) -> None:
        """Clear the targets of ``attributes`` and draw ``count`` triangles of ``splat_pass``, in order."""
        targets = self.targets_for(attributes, camera)
        targets.framebuffer.use()
        targets.framebuffer.clear()
        if count == 0:
            return
        splat.bind(textures, size=(camera.width, camera.height))
        self.context.enable_only(moderngl.BLEND)
        self.context.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        part = -(-count // FLUSHES)
        for start in range(0, count, part):
            splat.render(moderngl.TRIANGLES, 3 * min(part, count - start), first=3 * start)
            self.context.extra.flush()

    def _upload(self, records: Floats32) -> moderngl.Texture:
        rows, texels = records.shape[0], records.shape[1]
        texture = self._records
        if texture is None or texture.width != texels or texture.height < rows:
            if texture is not None:
                texture.release()
            texture = self._records = self.context.texture((texels, rows), 4, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        texture.write(records, viewport=(0, 0, texels, rows))
        return texture

    def read(self, attributes: int, camera: Camera) -> list[Floats32]:
        """Images [H, W, ≤ 4] of each target; the first one's fourth channel is alpha."""
        targets = self.targets_for(attributes, camera)
        target_images = []
        for index, texture in enumerate(targets.textures):
            target_image = np.empty((camera.height, camera.width, texture.components), np.float32)
            targets.framebuffer.read_into(
                target_image, components=texture.components, attachment=index, dtype="f4", alignment=1
            )
            target_images.append(target_image)
        return target_images

    def targets_for(self, attributes: int, camera: Camera) -> Targets:
        """Float32 targets for ``attributes`` at the camera's size; those of other sizes are released."""
        key = (attributes, camera.width, camera.height)
        if key not in self._targets:
            textures = []
            for first in range(0, attributes, PER_TARGET):
                left = attributes - first
                components = 4 if first == 0 or left >= PER_TARGET else left
                textures.append(self.context.texture((camera.width, camera.height), components, dtype="f4"))
            self._targets[key] = Targets.of(self.context, textures)
            # only now: on making a framebuffer moderngl rebinds the one in use
            for other in [old for old in self._targets if old[1:] != key[1:]]:
                self._targets.pop(other).release()
        return self._targets[key]


def splat_pass(context: moderngl.Context, attributes: int, *, lit: bool = False) -> Pass:
    """The program that draws a triangle for each Gaussian, back to front.

    With ``lit`` the three attributes come from the ``radiance`` texture.
    """
    values = [f"attributes[{i // 4}].{'xyzw'[i % 4]}" for i in range(attributes)]
    values += ["0.0"] * (-attributes % PER_TARGET)
    targets = range(len(values) // PER_TARGET)
    macros = {
        "ATTRIBUTES": attributes,
        "OUTPUTS": " ".join(f"layout(location = {t}) out vec4 target_{t};" for t in targets),
        "WRITES": " ".join(
            f"target_{t} = alpha * vec4({', '.join(values[PER_TARGET * t : PER_TARGET * (t + 1)])}, 1.0);"
            for t in targets
        ),
        **({"LIT": 1} if lit else {"TEXELS": GEOMETRY_TEXELS + -(-attributes // 4)}),
    }
    return Pass(context, ("splat.vert",), ("splat.frag",), macros)


class Ellipses(NamedTuple):
    """Projected Gaussians; rows as in ``raster.tiles.Splats``."""

    order: NDArray[np.int32]  # [V] indices of rendered ones, front to back
    centers: NDArray[np.float64]
    shapes: Floats32
    attributes: Floats32  # [N, C + 1] features, depth


def sorted_ellipses(
    means: Floats32, covariances: Floats32, opacities: Floats32, features: Floats32, view: Pinhole
) -> Ellipses:
    return Ellipses(*_project_and_sort(means, covariances, opacities, features, view))


# Single-threaded: idle numba threads spin and slow llvmpipe's (14 of 62 ms).
@njit(error_model="numpy", nogil=True, cache=True)
def _project_and_sort(means, covariances, opacities, features, view):  # type: ignore[no-untyped-def]
    count = means.shape[0]
    centers, shapes = np.empty((count, 2), np.float64), np.empty((count, 4), np.float32)
    boxes, attributes = np.empty((count, 4), np.int32), np.empty((count, features.shape[1] + 1), np.float32)
    depths, starts = np.empty(count, np.float64), np.empty(count + 1, np.int64)
    starts[0] = 0
    outputs = (centers, shapes, boxes, attributes, depths, starts[1:])
    everything = np.empty(0, np.bool_)
    project_range(0, count, means, covariances, opacities, features, everything, view, outputs)
    for i in range(count):
        starts[i + 1] += starts[i]
    return front_to_back(depths, starts), centers, shapes, attributes


def _records(splats: Ellipses, first: int, attributes: int, camera: Camera) -> Floats32:
    """The shaders' texture, back to front: [rows, ROW_GAUSSIANS · texels, 4]."""
    texels = GEOMETRY_TEXELS + -(-attributes // 4)
    rows = -(-len(splats.order) // ROW_GAUSSIANS)
    records = np.empty((rows * ROW_GAUSSIANS, 4 * texels), np.float32)
    middle = camera.width / 2, camera.height / 2
    drawn = splats.order, splats.centers, splats.shapes, splats.attributes
    _fill_records(records, *drawn, middle, first, attributes)
    return records.reshape(rows, ROW_GAUSSIANS * texels, 4)


@njit(error_model="numpy", nogil=True, cache=True)
def _fill_records(records, order, centers, shapes, values, middle, first, attributes):  # type: ignore[no-untyped-def]
    count = order.size
    for k in range(count):
        i = order[count - 1 - k]
        shear, fall_y, fall_x, peak = shapes[i, 0], shapes[i, 1], shapes[i, 2], shapes[i, 3]
        records[k, 0], records[k, 1] = centers[i, 0] - middle[0], centers[i, 1] - middle[1]
        records[k, 2], records[k, 3] = np.sqrt(max(peak + LOG2_255, 0.0)), peak
        records[k, 4], records[k, 5], records[k, 6], records[k, 7] = (np.sqrt(fall_x), np.sqrt(fall_y), shear, 0.0)
        for c in range(attributes):
            records[k, 8 + c] = values[i, first + c]


def _assembled(target_images: list[Floats32], channels: int, depth: bool, seconds: dict[str, float]) -> Raster:
    """Targets [H, W, ≤ 4] → the raster; views where possible."""
    if channels <= PER_TARGET:
        image = target_images[0][..., :channels]
    else:
        image = np.empty((*target_images[0].shape[:2], channels), np.float32)
        for index, target_image in enumerate(target_images):
            _copy_channels(image, PER_TARGET * index, target_image)
    alpha = target_images[0][..., 3]
    far = target_images[channels // PER_TARGET][..., channels % PER_TARGET] if depth else np.zeros_like(alpha)
    return Raster(image, alpha, far, seconds)


@njit(error_model="numpy", nogil=True, cache=True)
def _copy_channels(image, first, target_image):  # type: ignore[no-untyped-def]
    """Three times as fast as numpy, which calls memcpy for every pixel."""
    count = min(PER_TARGET, target_image.shape[2], image.shape[2] - first)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for c in range(count):
                image[y, x, first + c] = target_image[y, x, c]
