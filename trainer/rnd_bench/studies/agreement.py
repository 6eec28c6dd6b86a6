"""Our renderer with true attributes against Mitsuba: a ball and a person under every light of the stage.

The runtime renders Gaussians with true positions, normals, albedo and roughness, and with visibility fitted to traced
shadows. Mitsuba renders the same surface with direct light, as our model does, and with interreflection.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.sh import sh_basis, sphere_quadrature
from rnd_runtime.shading.shader import SHADOW_RESOLUTION, Shader
from rnd_runtime.shading.shadow import directional_visibility
from rnd_stage.film.lights import stage_lights
from rnd_stage.materials import Material
from rnd_stage.render import RenderSet, Surface

Floats = NDArray[np.float64]

MODES = ("brute", "table+sun")  # shading modes of the runtime that are compared
# Visibility is traced in 2 · 14² = 392 directions. Against 800, the person's irradiance under a white sky differs by
# 0.8 % rms and 0.004 % on average.
QUADRATURE = 14
DISC, THICKNESS = 0.55, 0.05  # standard deviations of a Gaussian in its plane and across, in spacings
OPACITY = 0.99
RIM = 2  # pixels at the silhouette excluded from "inside": splats have softer edges
DIRECT, FULL = 2, 5  # path depths
PROBE = (32, 64)  # texels of our sums, as in training


@dataclass(frozen=True, eq=False)
class Comparison:
    """One body under one light.

    Attributes:
        row: see ``compare``.
        ours, direct, full: linear radiance [H, W, 3]: the runtime's in the first mode, Mitsuba's of direct light,
            Mitsuba's with interreflection.
    """

    row: dict[str, Any]
    ours: NDArray[np.floating]
    direct: Floats
    full: Floats

    def strip(self) -> Floats:
        """sRGB [H, 4·W, 3]: ours, direct, four times their difference, interreflection."""
        ours, direct, full = (linear_to_srgb(np.clip(x, 0, 1)) for x in (self.ours, self.direct, self.full))
        return np.concatenate([ours, direct, np.clip(4 * np.abs(ours - direct), 0, 1), full], axis=1)


def ball(radius: float = 0.5, height: float = 0.92, rings: int = 96) -> Surface:
    """A ball before the stage's cameras, with true normals, a checked albedo and roughness from 0.25 to 0.8."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    index = np.arange(polar.size).reshape(polar.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    normals = normals.reshape(-1, 3)
    smooth = 0.5 + 0.5 * np.sin(4 * azimuth.ravel()) * np.sin(3 * polar.ravel())
    colour = np.stack([0.15 + 0.5 * smooth, 0.45 - 0.2 * smooth, 0.6 - 0.45 * smooth], axis=1)
    return Surface(radius * normals + [0, height, 0], normals, faces, colour, 0.25 + 0.55 * smooth)


def true_gaussians(surface: Surface) -> Gaussians:
    """A Gaussian with true attributes at every vertex; those closer than half the spacing are merged."""
    vertices, spacing = surface.vertices, _spacing(surface)
    chosen = _thinned(vertices, 0.5 * spacing)
    points, normals = vertices[chosen], surface.normals[chosen]
    local = cKDTree(points).query(points, k=5)[0][:, 1:].mean(axis=1)
    sigma = DISC * np.clip(local, 0.5 * spacing, 2 * spacing)
    outer = normals[:, :, None] * normals[:, None, :]
    flat = np.eye(3) - outer
    covariance = sigma[:, None, None] ** 2 * (flat + THICKNESS**2 * outer)
    upper = covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    visibility = fitted_visibility(points, normals, 1.25 * local.mean())
    return Gaussians(
        means=np.ascontiguousarray(points, np.float32),
        covariances=np.ascontiguousarray(upper, np.float32),
        opacities=np.full(len(points), OPACITY, np.float32),
        normals=np.ascontiguousarray(normals, np.float32),
        albedo=np.ascontiguousarray(surface.colour[chosen], np.float32),
        roughness=np.ascontiguousarray(surface.roughness[chosen], np.float32),
        visibility=visibility.astype(np.float32),
        root_rotation=np.eye(3, dtype=np.float32),
    )


def fitted_visibility(points: Floats, normals: Floats, radius: float) -> Floats:
    """SH coefficients [N, 16] fitted to traced shadows by least squares weighted with the cosine."""
    directions, areas = sphere_quadrature(QUADRATURE)
    traced = directional_visibility(points, normals, directions, radii=radius, resolution=SHADOW_RESOLUTION)
    basis = sh_basis(directions)
    weight = np.maximum(normals @ directions.T, 0) * areas * len(areas) / (4 * np.pi)
    result = np.empty((len(points), basis.shape[1]))
    ridge = 1e-3 * np.eye(basis.shape[1])
    clear = np.zeros(basis.shape[1])
    clear[0] = np.sqrt(4 * np.pi)  # the prior below the horizon: visible
    for start in range(0, len(points), 2048):
        part = slice(start, start + 2048)
        weighted = weight[part, :, None] * basis
        rows = weighted.swapaxes(1, 2)  # [n, 16, K]
        normal_matrix = rows @ basis + ridge
        right = (rows @ traced[part, :, None])[..., 0] + ridge @ clear
        result[part] = np.linalg.solve(normal_matrix, right[..., None])[..., 0]
    return result


def compare(
    name: str,
    surface: Surface,
    camera: Camera,
    samples: int,
    chosen: tuple[str, ...] = (),
    material: Material = "layered",
) -> Iterator[Comparison]:
    """One body of ``material`` under every light, or those ``chosen``, with ``samples`` of Mitsuba's paths per pixel.

    In a row, ``psnr`` is of sRGB images against direct light, ``psnr_inside`` of the pixels well inside the
    silhouette, ``energy`` the ratio ours / Mitsuba's there; ``interreflection_*`` compares Mitsuba's direct light with
    its full paths; ``noise_psnr`` is the upper bound by Mitsuba's noise.
    """
    lights = {light.name: light for light in stage_lights()}
    unknown = sorted(set(chosen) - set(lights))
    if unknown:
        raise InputError("--lights", expected=", ".join(lights), got=", ".join(unknown))
    gaussians = true_gaussians(surface)
    direct, full = (RenderSet(surface, max_depth=depth, material=material) for depth in (DIRECT, FULL))
    coverage = full.truth(camera, samples=16, seed=0).coverage
    inside = binary_erosion(coverage > 0.99, iterations=RIM)
    if not inside.any():
        raise InputError("--size", expected=f"pixels inside the {name}", got=camera.width)
    for light in lights.values():
        if chosen and light.name not in chosen:
            continue
        started = time.process_time()
        first, second = (direct.radiance(camera, light.radiance, samples=samples // 2, seed=seed) for seed in (1, 2))
        truth = 0.5 * (first + second)
        paths = full.radiance(camera, light.radiance, samples=samples, seed=3)
        row: dict[str, Any] = {
            "body": name,
            "light": light.name,
            "material": material,
            "gaussians": len(gaussians.means),
            "size": camera.width,
            "samples": samples,
            # the mean of both halves has half the deviation of their difference
            "noise_psnr": _psnr(first, second, inside) + 20 * np.log10(2),
            "interreflection_psnr": _psnr(truth, paths, inside),
            "interreflection_energy": float(paths[inside].sum() / truth[inside].sum() - 1),
        }
        images = []
        for mode in MODES:
            shader = Shader(Light(light.radiance.astype(np.float32)), mode, texels=PROBE)
            radiance = shader.shade(gaussians, camera.position)
            ours = rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, radiance, camera).image
            images.append(ours)
            row[mode] = {
                "psnr": _psnr(ours, truth, np.ones_like(inside)),
                "psnr_inside": _psnr(ours, truth, inside),
                "psnr_inside_full": _psnr(ours, paths, inside),
                "energy": float(ours[inside].sum() / truth[inside].sum()),
            }
        row["cpu_seconds"] = round(time.process_time() - started, 2)
        yield Comparison(row, images[0], truth, paths)


def _psnr(a: NDArray[np.floating], b: NDArray[np.floating], where: NDArray[np.bool_]) -> float:
    first, second = (linear_to_srgb(np.clip(x, 0, 1))[where] for x in (a, b))
    return float(-10 * np.log10(max(float(np.mean((first - second) ** 2)), 1e-12)))


def _spacing(surface: Surface) -> float:
    """The square root of the area per vertex."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return float(np.sqrt(area / len(surface.vertices)))


def _thinned(points: Floats, distance: float) -> NDArray[np.int64]:
    """Indices of points at least ``distance`` apart, the first of each cluster."""
    gone = np.zeros(len(points), bool)
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    for i, j in pairs[np.lexsort(pairs.T[::-1])]:
        if not gone[i]:
            gone[j] = True
    return np.flatnonzero(~gone)
