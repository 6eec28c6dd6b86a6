"""Arbitrary output variables (AOVs), splatted in the same pass as the radiance.

==========  =======================================  ==================================================
name        8-bit image                              EXR layer (float)
==========  =======================================  ==================================================
albedo      sRGB, premultiplied, on black            albedo.R, .G, .B: linear, premultiplied
normal      (n + 1) / 2                              normal.X, .Y, .Z: unit
roughness   linear                                   roughness.Y
visibility  linear                                   visibility.Y: cosine-weighted share of a uniform sky
depth       near is bright, over the body's reach    Z: metres along the camera's axis
diffuse     sRGB, premultiplied, on black            diffuse.R, .G, .B: linear radiance, premultiplied
specular    sRGB, premultiplied, on black            specular.R, .G, .B: the rest of the radiance, premultiplied
shadow      sRGB, premultiplied, on black            shadow.R, .G, .B: radiance that cast shadows of directional
                                                     lights take away, premultiplied: added, it undoes them
motion      red, green: 0.5 + pixels / 64            forward.u, .v: pixels to the right and up, to the next frame
parts       a colour for each joint's part           CryptoPart00 … 02: see ``playback.cryptomatte``
==========  =======================================  ==================================================

Normals are in the camera's OpenCV axes, as captures have them: what faces the camera has z < 0.
All but colours and parts are averages over the covered part of a pixel, zero below ``MIN_COVERAGE``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians, Raster
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.raster.oracle import NEAR
from rnd_runtime.shading.sh import COSINE_LOBE, sh_basis
from rnd_runtime.shading.shader import Shader

from . import cryptomatte

# EXR channels of each output
CHANNELS = {
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "roughness": ("roughness.Y",),
    "visibility": ("visibility.Y",),
    "depth": ("Z",),
    "diffuse": ("diffuse.R", "diffuse.G", "diffuse.B"),
    "specular": ("specular.R", "specular.G", "specular.B"),
    "shadow": ("shadow.R", "shadow.G", "shadow.B"),
    "motion": ("forward.u", "forward.v"),
    "parts": cryptomatte.CHANNELS,
}
COLOURS = ("albedo", "diffuse", "specular", "shadow")
"""linear Rec.709, premultiplied"""
GIVEN = ("motion", "parts")
"""whose features [N, C] come from the caller: they need more than one frame's Gaussians"""
MOTION_RANGE = 32.0
"""pixels of motion at the ends of the 8-bit image"""
MIN_COVERAGE = 0.05  # the captures' own limit for normals


def parse_aovs(text: str) -> tuple[str, ...]:
    """``albedo,depth`` → names in the order of ``CHANNELS``, without repetitions; ``""`` → none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    if unknown := names - CHANNELS.keys():
        raise InputError("--aov", expected=f"any of {','.join(CHANNELS)}", got=",".join(sorted(unknown)))
    return tuple(name for name in CHANNELS if name in names)


class Lit(NamedTuple):
    """How Gaussians were shaded: by ``shader``, towards a camera at ``eye`` [3] m, to ``radiance`` [N, 3].

    ``sunlit`` as of ``Shader.shade``.
    """

    shader: Shader
    eye: NDArray[np.float64]
    seen: NDArray[np.bool_] | None
    radiance: Floats32
    sunlit: Floats32 | None = None

    def again(self, gaussians: Gaussians, sunlit: Floats32 | None = None) -> Floats32:
        """Radiance [N, 3] of other ``gaussians``, or of others that are ``sunlit``."""
        return self.shader.shade(gaussians, self.eye, self.seen, sunlit=self.sunlit if sunlit is None else sunlit)


def splat_features(
    names: Sequence[str], gaussians: Gaussians, camera: Camera, lit: Lit, given: Mapping[str, Floats32]
) -> list[Floats32]:
    """Features [N, C] to rasterise for each of ``names``; depth has none. ``given``: those of ``GIVEN``.

    From an albedo of F0 on, radiance is linear in albedo: its slope is the diffuse part, the rest is specular.
    """
    diffuse = np.zeros_like(gaussians.albedo)
    if {"diffuse", "specular"} & {*names}:
        once, twice = (lit.again(replace(gaussians, albedo=np.full_like(diffuse, level))) for level in (1, 2))
        diffuse = gaussians.albedo * (twice - once)
    features = {
        "albedo": lambda: gaussians.albedo,
        "normal": lambda: gaussians.normals @ camera.world_to_camera[:3, :3].T.astype(np.float32),
        "roughness": lambda: gaussians.roughness[:, None],
        "visibility": lambda: ambient_visibility(gaussians)[:, None],
        "diffuse": lambda: diffuse,
        "specular": lambda: lit.radiance - diffuse,
        "shadow": lambda: (
            lit.again(gaussians, np.ones((len(lit.radiance), len(lit.shader.directional)), np.float32)) - lit.radiance
        ),
    }
    return [given[name] if name in GIVEN else features[name]() for name in names if name != "depth"]


def pixel_motion(now: Gaussians, camera: Camera, following: Gaussians, next_camera: Camera) -> Floats32:
    """Pixels [N, 2], right and up, by which Gaussians move to the next frame; each with the camera in its own frame.

    Zero behind a camera.
    """
    (here, depth), (there, next_depth) = (
        view.project(gaussians.means) for gaussians, view in ((now, camera), (following, next_camera))
    )
    in_front = (depth > NEAR) & (next_depth > NEAR)
    moved = np.where(in_front[:, None], there - here, 0) * [1, -1]
    return moved.astype(np.float32)


def ambient_visibility(gaussians: Gaussians) -> Floats32:
    """(1/π) ∫ v(ω) max(n·ω, 0) dω [N], clipped to [0, 1]: the visible share of a uniform sky's irradiance."""
    normals_root = gaussians.normals @ gaussians.root_rotation
    lobe = sh_basis(normals_root) * COSINE_LOBE
    share: Floats32 = np.clip((gaussians.visibility * lobe).sum(axis=1), 0, 1)
    return share


def aov_layers(names: Sequence[str], raster: Raster, first: int, given: Mapping[str, Floats32]) -> dict[str, Floats32]:
    """``aov_values`` of ``names``; their channels begin at ``first`` in the raster's image."""
    layers = {}
    for name in names:
        if name == "depth":
            splatted = raster.depth[..., None]
        else:
            count = given[name].shape[1] if name in given else len(CHANNELS[name])
            splatted = raster.image[..., first : first + count]
            first += count
        layers[name] = aov_values(name, splatted, raster.alpha)
    return layers


def aov_values(name: str, splatted: Floats32, alpha: Floats32) -> Floats32:
    """Layer of ``name`` [H, W, C] from the raster's premultiplied channels; of parts their coverage [H, W, P]."""
    if name in COLOURS or name == "parts":
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
    if name in COLOURS:
        return to_bytes(linear_to_srgb(values))
    if name == "parts":
        return cryptomatte.colours(values)
    covered = (alpha >= MIN_COVERAGE)[..., None]
    if name == "normal":
        return to_bytes((values + 1) / 2 * covered)
    if name == "motion":
        coded = to_bytes((values / MOTION_RANGE + 1) / 2)
        return np.dstack([coded, np.zeros_like(coded[..., :1])])
    if name == "depth":
        near, far = depth_range
        return to_bytes(np.clip((far - values) / (far - near), 0, 1) * covered)
    return to_bytes(values)
