"""Arbitrary output variables (AOVs), splatted in the same pass as the radiance.

==========  =======================================  ==================================================
name        8-bit image                              EXR layer (float)
==========  =======================================  ==================================================
albedo      sRGB, premultiplied, on black            albedo.R, .G, .B: linear, premultiplied
normal      (n + 1) / 2                              normal.X, .Y, .Z: unit
roughness   linear                                   roughness.Y
visibility  linear                                   visibility.Y: cosine-weighted share of a uniform sky
depth       near is bright, over the body's reach    Z: metres along the camera's axis
==========  =======================================  ==================================================

Normals are in the camera's OpenCV axes, as captures have them: what faces the camera has z < 0.
All but albedo are averages over the covered part of a pixel, zero below ``MIN_COVERAGE``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians, Raster
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.shading.sh import COSINE_LOBE, sh_basis

# EXR channels of each output
CHANNELS = {
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "roughness": ("roughness.Y",),
    "visibility": ("visibility.Y",),
    "depth": ("Z",),
}
MIN_COVERAGE = 0.05  # the captures' own limit for normals


def parse_aovs(text: str) -> tuple[str, ...]:
    """``albedo,depth`` → names in the order of ``CHANNELS``, without repetitions; ``""`` → none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if unknown := names - CHANNELS.keys():
        raise InputError("--aov", expected=f"any of {','.join(CHANNELS)}", got=",".join(sorted(unknown)))
    return tuple(name for name in CHANNELS if name in names)


def splat_features(names: Sequence[str], gaussians: Gaussians, camera: Camera) -> list[Floats32]:
    """Features [N, C] to rasterise for each of ``names``; depth has none."""
    features = {
        "albedo": lambda: gaussians.albedo,
        "normal": lambda: gaussians.normals @ camera.world_to_camera[:3, :3].T.astype(np.float32),
        "roughness": lambda: gaussians.roughness[:, None],
        "visibility": lambda: ambient_visibility(gaussians)[:, None],
    }
    return [features[name]() for name in names if name != "depth"]


def ambient_visibility(gaussians: Gaussians) -> Floats32:
    """(1/π) ∫ v(ω) max(n·ω, 0) dω [N], clipped to [0, 1]: the visible share of a uniform sky's irradiance."""
    normals_root = gaussians.normals @ gaussians.root_rotation
    lobe = sh_basis(normals_root) * COSINE_LOBE
    share: Floats32 = np.clip((gaussians.visibility * lobe).sum(axis=1), 0, 1)
    return share


def aov_layers(names: Sequence[str], raster: Raster, first: int) -> dict[str, Floats32]:
    """``aov_values`` of ``names``; their channels begin at ``first`` in the raster's image."""
    layers = {}
    for name in names:
        if name == "depth":
            splatted = raster.depth[..., None]
        else:
            splatted = raster.image[..., first : first + len(CHANNELS[name])]
            first += len(CHANNELS[name])
        layers[name] = aov_values(name, splatted, raster.alpha)
    return layers


def aov_values(name: str, splatted: Floats32, alpha: Floats32) -> Floats32:
    """EXR layer of ``name`` [H, W, C] from the raster's premultiplied channels."""
    if name == "albedo":
        return splatted
    covered = alpha >= MIN_COVERAGE
    mean: Floats32 = np.where(covered, 1 / np.where(covered, alpha, 1), 0).astype(np.float32)[..., None] * splatted
    if name == "normal":
        mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), np.float32(1e-6))
    return mean


def aov_image(
    name: str, values: Floats32, alpha: Floats32, depth_range: tuple[float, float] = (0, 1)
) -> NDArray[np.uint8]:
    """8-bit image [H, W, 1 or 3] of ``aov_values``; ``depth_range``: m, shown white and black."""
    if name == "albedo":
        return to_bytes(linear_to_srgb(values))
    covered = (alpha >= MIN_COVERAGE)[..., None]
    if name == "normal":
        return to_bytes((values + 1) / 2 * covered)
    if name == "depth":
        near, far = depth_range
        return to_bytes(np.clip((far - values) / (far - near), 0, 1) * covered)
    return to_bytes(values)
