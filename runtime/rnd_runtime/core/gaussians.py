"""Arrays exchanged by avatar, shading and rasterisers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .arrays import Floats32
from .camera import Camera


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N posed Gaussians with their material, in the frame of camera and light (world; the root's frame in playback).

    Attributes:
        means: [N, 3] m.
        covariances: [N, 6] m², upper triangle (xx, xy, xz, yy, yz, zz).
        opacities: [N] in [0, 1].
        normals: [N, 3] unit, outward.
        albedo: [N, 3] linear Rec.709 diffuse albedo in [0, 1].
        roughness: [N] perceptual roughness γ; GGX's α is γ².
        visibility: [N, 16] SH coefficients of the visibility of a light as a function of the direction **towards** it,
            root frame.
        root_rotation: [3, 3], root frame → this one.
    """

    means: Floats32
    covariances: Floats32
    opacities: Floats32
    normals: Floats32
    albedo: Floats32
    roughness: Floats32
    visibility: Floats32
    root_rotation: Floats32

    def only(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> Gaussians:
        """The Gaussians of a mask [N] or of indices."""
        names = (name for name in vars(self) if name != "root_rotation")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


@dataclass(frozen=True, eq=False)
class Raster:
    """A splatted image, premultiplied by alpha.

    Attributes:
        image: [H, W, C], Σ w_i feature_i.
        alpha: [H, W], Σ w_i.
        depth: [H, W] m, Σ w_i z_i, z the camera-space depth of the mean.
        seconds: duration of each stage: "projection", "sort" and "raster" on the CPU, "projection+sort", "raster" and
            "read-back" with GL, and stages added by the renderer of whole frames.
        srgb: [H, W, 3] 8-bit over black as by ``raster.tone.tone_map``, where made along with the rest.
    """

    image: Floats32
    alpha: Floats32
    depth: Floats32
    seconds: Mapping[str, float] = field(default_factory=dict)
    srgb: NDArray[np.uint8] | None = None


class Rasterizer(Protocol):
    """Interface of all rasterisers.

    The rule is 3DGS's (Kerbl et al. 2023) with a dilation of 0.05 px² instead of 0.3: EWA projection,
    α = min(0.99, o·exp(−½ dᵀΣ⁻¹d)), α < 1/255 skipped, blending front to back by the camera depth of the means
    (ties by index), stop before the Gaussian that would take the transmittance below 1e-4.
    """

    def __call__(
        self,
        means: Floats32,  # [N, 3] m, world
        covariances: Floats32,  # [N, 6] m², world
        opacities: Floats32,  # [N]
        features: Floats32,  # [N, C]
        camera: Camera,
        *,
        depth: bool = True,  # False: the depth image is zero
    ) -> Raster: ...
