"""Posed Gaussians on an OpenGL device, and their upload."""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np

from rnd_runtime.core.arrays import checked, floats
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.sh import SH_COUNT
from rnd_runtime.shading.shader import shadow_radii

from .passes import GaussianTexture


class Surfaces(NamedTuple):
    """N Gaussians in textures laid out as ``gl.passes.GaussianTexture``.

    "World" in the shaders is the frame of camera and light, as in ``core.gaussians.Gaussians``.
    """

    points: moderngl.Texture  # mean m; disc radius m, 0 where it casts no shadow
    normals: moderngl.Texture  # unit; opacity
    covariances: moderngl.Texture  # xx, xy, xz, yy m²
    covariances_z: moderngl.Texture  # yz, zz
    visibility: moderngl.Texture  # four texels: SH coefficients, root frame
    materials: moderngl.Texture  # albedo, roughness
    gaussians: int  # N

    def textures(self) -> dict[str, moderngl.Texture]:
        """Textures by sampler name."""
        return {name: value for name, value in self._asdict().items() if name != "gaussians"}


class SurfaceUpload:
    """Uploads ``core.gaussians.Gaussians``; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._four = [GaussianTexture(context, 4) for _ in range(4)]
        self._two, self._visibility = GaussianTexture(context, 2), GaussianTexture(context, 4, texels=4)

    def write(self, gaussians: Gaussians) -> Surfaces:
        """Upload ``gaussians``.

        Raises:
            InputError: an array has the wrong shape.
        """
        means, covariances, opacities, normals = checked(
            gaussians.means, gaussians.covariances, gaussians.opacities, gaussians.normals
        )
        count = len(means)
        shapes = {"normals": (count, 3), "albedo": (count, 3), "visibility": (count, SH_COUNT)}
        for name, shape in shapes.items():
            if getattr(gaussians, name).shape != shape:
                raise InputError(name, expected=f"shape {shape}", got=getattr(gaussians, name).shape)
        rows = np.empty((4, count, 4), np.float32)
        rows[0, :, :3], rows[0, :, 3] = means, shadow_radii(gaussians)
        rows[1, :, :3], rows[1, :, 3] = normals, opacities
        rows[2] = covariances[:, :4]
        rows[3, :, :3], rows[3, :, 3] = gaussians.albedo, gaussians.roughness
        points, outward, first, materials = (texture.write(row) for texture, row in zip(self._four, rows))
        return Surfaces(
            points,
            outward,
            first,
            self._two.write(np.ascontiguousarray(covariances[:, 4:])),
            self._visibility.write(floats(gaussians.visibility)),
            materials,
            count,
        )

    def release(self) -> None:
        for texture in (*self._four, self._two, self._visibility):
            texture.release()
