"""Arbitrary output variables: what a compositor wants beside the picture, splatted in the same pass.

==========  =======================================  ==================================================
name        PNG (8 bit)                              EXR layer (float)
==========  =======================================  ==================================================
albedo      sRGB, premultiplied, on black            albedo.R, .G, .B: linear, premultiplied
normal      (n + 1) / 2                              normal.X, .Y, .Z: unit
roughness   linear                                   roughness.Y
visibility  linear                                   visibility.Y: cosine-weighted share of a uniform sky
depth       near is bright, over the body's reach    Z: metres along the camera's axis
==========  =======================================  ==================================================

Normals are in the camera's OpenCV axes, as captures have them: what faces the camera has z < 0.
All but albedo are averages over what covers the pixel: zero where that is less than ``MIN_COVERAGE``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.core.sh import SH_DEGREES, sh_basis

Floats32 = NDArray[np.float32]

# Channels of each output in the raster's features and in the EXR; depth comes from the raster itself.
CHANNELS = {
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "roughness": ("roughness.Y",),
    "visibility": ("visibility.Y",),
    "depth": ("Z",),
}
MIN_COVERAGE = 0.05  # the captures' own limit for normals
# The cosine lobe's coefficients over π, for each of the 16 functions (Ramamoorthi, Hanrahan 2001).
COSINE_LOBE = np.array([1, 2 / 3, 1 / 4, 0], np.float32)[SH_DEGREES]


def parse_aovs(text: str) -> tuple[str, ...]:
    """``albedo,depth`` → names in the order of ``CHANNELS``, without repetitions; ``""`` → none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if unknown := names - CHANNELS.keys():
        raise InputError("--aov", expected=f"any of {','.join(CHANNELS)}", got=",".join(sorted(unknown)))
    return tuple(name for name in CHANNELS if name in names)


def splat_features(names: tuple[str, ...], gaussians: Gaussians, camera: Camera) -> list[Floats32]:
    """The features [N, C] to rasterise for ``names``, depth left out."""
    columns: list[Floats32] = []
    for name in names:
        if name == "albedo":
            columns.append(gaussians.albedo)
        elif name == "normal":
            columns.append(gaussians.normals @ camera.world_to_camera[:3, :3].T.astype(np.float32))
        elif name == "roughness":
            columns.append(gaussians.roughness[:, None])
        elif name == "visibility":
            columns.append(ambient_visibility(gaussians)[:, None])
    return columns


def ambient_visibility(gaussians: Gaussians) -> Floats32:
    """(1/π) ∫ v(ω) max(n·ω, 0) dω [N], clipped to [0, 1]: what of a uniform sky's irradiance arrives."""
    normals_root = gaussians.normals @ gaussians.root_rotation
    lobe = sh_basis(normals_root) * COSINE_LOBE
    return np.clip((gaussians.visibility * lobe).sum(axis=1), 0, 1)


def coverage_mean(values: Floats32, alpha: Floats32) -> Floats32:
    """Premultiplied ``values`` [H, W, C] divided by ``alpha`` [H, W]; zero below ``MIN_COVERAGE``."""
    enough = alpha >= MIN_COVERAGE
    return np.where(enough, 1 / np.where(enough, alpha, 1), 0).astype(np.float32)[..., None] * values


def aov_values(name: str, splatted: Floats32, alpha: Floats32) -> Floats32:
    """What the EXR layer of ``name`` holds [H, W, C], from the raster's premultiplied channels."""
    if name == "albedo":
        return splatted
    mean = coverage_mean(splatted, alpha)
    if name == "normal":
        return mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-6)
    return mean


def aov_picture(name: str, values: Floats32, alpha: Floats32, reach: tuple[float, float]) -> NDArray[np.uint8]:
    """The 8-bit picture [H, W, 1 or 3] of ``aov_values``; ``reach``: depths (m) shown white and black."""
    if name == "albedo":
        return to_bytes(linear_to_srgb(values))
    covered = (alpha >= MIN_COVERAGE)[..., None]
    if name == "normal":
        return to_bytes((values + 1) / 2 * covered)
    if name == "depth":
        near, far = reach
        return to_bytes(np.clip((far - values) / (far - near), 0, 1) * covered)
    return to_bytes(values)
