"""The arrays that travel between the avatar, the shading and the rasterisers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

Floats32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N posed Gaussians with their material, in the frame of camera and light: the world, or in playback the root.

    Attributes:
        means: [N, 3] m.
        covariances: [N, 6] m², upper triangle (xx, xy, xz, yy, yz, zz).
        opacities: [N] in [0, 1].
        normals: [N, 3] unit, pointing out of the body.
        albedo: [N, 3] linear Rec.709 diffuse albedo in [0, 1].
        roughness: [N] perceptual roughness γ; GGX's α is γ².
        visibility: [N, 16] SH coefficients (degree 3) of the light that reaches the point, as a
            function of the direction **towards** the light in the root's frame.
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
        """Those of a mask [N] or of indices."""
        names = (name for name in vars(self) if name != "root_rotation")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


@dataclass(frozen=True, eq=False)
class Raster:
    """A splatted image; everything is premultiplied by alpha and composites over any background.

    Attributes:
        image: [H, W, C], Σ w_i feature_i.
        alpha: [H, W], Σ w_i.
        depth: [H, W] m, Σ w_i z_i with z the camera-space depth of the mean (divide by alpha).
        seconds: how long each stage took, by its name: "projection", "sort" and "raster" from the CPU, from a GL target
            "projection+sort", "raster" and "read-back"; who draws whole frames adds what comes before and after.
        srgb: [H, W, 3] 8-bit over black, the bytes of ``raster.tone.tone_map``, if they were made with the
            rest: by a device, or in one call of the CPU's.
    """

    image: Floats32
    alpha: Floats32
    depth: Floats32
    seconds: Mapping[str, float] = field(default_factory=dict)
    srgb: NDArray[np.uint8] | None = None


class Rasterizer(Protocol):
    """The interface of all rasterisers: the oracle, the CPU kernel, GL.

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
        depth: bool = True,  # False: the depth image is all zero, and costs nothing
    ) -> Raster: ...
