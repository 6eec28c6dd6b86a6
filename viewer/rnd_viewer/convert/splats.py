"""A posed, relit avatar as plain 3D Gaussians.

Colour = 0.5 + Σ c_lm Y_lm(d) with d from the camera to the splat, blended in sRGB. We blend radiance and code the sum;
``stored_colours`` corrects for that. ``linear`` stores radiance, for renderers that blend it and code afterwards.

Source: Kerbl et al. 2023, 3D Gaussian Splatting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.core.rotations import matrix_to_quaternion
from rnd_runtime.shading.sh import SH_COUNT, sh_basis

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Colour = Literal["lit", "albedo"]
Coding = Literal["srgb", "linear"]

SH_0 = 0.28209479177387814  # Y_00
VIEWS = 64  # directions of the fit of view-dependent colour: four times the unknowns
BACK_WEIGHT, RIDGE = 0.01, 1e-4  # weight of views from behind; ridge of the coefficients
FAR = 100.0  # m; view directions within the body differ by 0.5°
CELL_SPACINGS = 2.5  # a cell's side, in spacings: the best of 1 to 4
GRID_OFFSETS = (0.0, 0.25, 0.5, 0.75)  # of a cell, along its diagonal: as good as all eight half offsets
MIN_SIGMA = 1e-6  # m; logarithms are stored


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians for storage.

    Attributes:
        means: [N, 3] m. scales: [N, 3] standard deviations, m. quaternions: [N, 4] wxyz, unit, w ≥ 0.
        opacities: [N] in [0, 1]. normals: [N, 3].
        sh: [N, 16, 3] SH coefficients of the colour, all but the first zero for a view-independent colour.
    """

    means: Floats
    scales: Floats
    quaternions: Floats
    opacities: Floats
    normals: Floats
    sh: Floats


def are_finite(gaussians: Gaussians) -> NDArray[np.bool_]:
    """Whether all numbers of each Gaussian are finite [N]."""
    arrays = (array for name, array in vars(gaussians).items() if name != "root_rotation")
    rows = np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
    return np.asarray(np.isfinite(rows).all(axis=1))


def make_splats(gaussians: Gaussians, sh: Floats) -> Splats:
    """Finite ``gaussians`` with ``sh`` [N, 16, 3] of ``fixed_colour`` or ``view_dependent_colour``."""
    xx, xy, xz, yy, yz, zz = gaussians.covariances.astype(np.float64).T
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    variances, axes = np.linalg.eigh(matrices)
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    return Splats(
        means=gaussians.means.astype(np.float64),
        scales=np.sqrt(np.maximum(variances, MIN_SIGMA**2)),
        quaternions=matrix_to_quaternion(axes),
        opacities=gaussians.opacities.astype(np.float64),
        normals=gaussians.normals.astype(np.float64),
        sh=sh,
    )


def stored_colours(gaussians: Gaussians, linear: Floats32, coding: Coding, spacing: float) -> Floats:
    """Colours [N, 3] to store for linear radiance; ``spacing`` between Gaussians, m.

    Coding before blending darkens where bright and dark Gaussians mix, by 6/255 in the mean over a person. Each coded
    colour is raised by code(mean) − mean(code) of its cell, averaged over four offset grids (31 → 36 dB).
    """
    if coding == "linear":
        return linear.astype(np.float64)
    coded = np.asarray(linear_to_srgb(linear), np.float64)
    lost = np.zeros_like(coded)
    for offset in GRID_OFFSETS:
        cells = np.floor(gaussians.means / (CELL_SPACINGS * spacing) + offset).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        mean, mean_coded = (_cell_means(cell.ravel(), gaussians.opacities, x) for x in (linear, coded))
        lost += (linear_to_srgb(mean) - mean_coded)[cell.ravel()] / len(GRID_OFFSETS)
    return coded + lost


def fixed_colour(colours: Floats) -> Floats:
    """SH coefficients [N, 16, 3] of a colour [N, 3] that is constant over views."""
    sh = np.zeros((len(colours), SH_COUNT, 3))
    sh[:, 0] = (colours - 0.5) / SH_0
    return sh


def view_dependent_colour(gaussians: Gaussians, colours_from: Callable[[Floats], Floats], degree: int) -> Floats:
    """SH coefficients [N, 16, 3], zero above ``degree``, of stored colours ``colours_from(eye)`` [N, 3].

    Least squares over views from all directions, weighted for each Gaussian by the cosine of its normal to the view
    (error 5.3 → 0.9 of 255).
    """
    directions = _sphere(VIEWS)
    count = (degree + 1) ** 2
    basis = sh_basis(-directions)[:, :count]  # from the camera to the splat
    weights = np.maximum(gaussians.normals @ directions.T, 0) + BACK_WEIGHT
    centre = gaussians.means.mean(axis=0).astype(np.float64)
    right = np.zeros((len(gaussians.means), count, 3))
    for view, direction in enumerate(directions):
        colours = colours_from(centre + FAR * direction) - 0.5
        right += basis[view][None, :, None] * (weights[:, view, None] * colours)[:, None, :]
    products = (basis[:, :, None] * basis[:, None, :]).reshape(VIEWS, -1)
    left = (weights @ products).reshape(-1, count, count) + RIDGE * np.eye(count)
    sh = np.zeros((len(gaussians.means), SH_COUNT, 3))
    sh[:, :count] = np.linalg.solve(left, right)
    return sh


def half_turned(splats: Splats) -> Splats:
    """``splats`` rotated by 180° about Z: Y down, as files trained on COLMAP cameras and as most viewers expect.

    (x, y, z) → (−x, −y, z) flips the sign of the SH coefficients that are odd in x and y together.
    """
    flip = np.array([-1.0, -1.0, 1.0])
    probe = np.array([[0.3, 0.5, 0.7]])
    probe /= np.linalg.norm(probe)
    signs = np.sign(sh_basis(probe * flip) * sh_basis(probe))[0]
    w, x, y, z = splats.quaternions.T
    rotated = np.stack([-z, -y, x, w], axis=-1)  # (0, 0, 0, 1) ⊗ q
    return Splats(
        splats.means * flip,
        splats.scales,
        np.where(rotated[:, :1] < 0, -rotated, rotated),
        splats.opacities,
        splats.normals * flip,
        splats.sh * signs[:, None],
    )


def _cell_means(cell: NDArray[np.intp], weights: Floats32, values: NDArray[np.floating]) -> Floats:
    total = np.maximum(np.bincount(cell, weights), np.finfo(np.float64).tiny)
    return np.stack([np.bincount(cell, weights * column) / total for column in values.T], axis=1)


def _sphere(count: int) -> Floats:
    """``count`` even directions on a golden spiral."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=-1)
