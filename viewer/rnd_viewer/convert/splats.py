"""A posed, relit avatar as the plain Gaussians that splat viewers know: no networks, no light, one moment.

What such a file means (Kerbl et al. 2023): colour = 0.5 + Σ c_lm Y_lm(d) with d from the camera to the splat,
blended as it is shown, so in display-coded (sRGB) values. We blend radiance and code the sum, and correct what
is stored for that (``stored_colours``); ``linear`` keeps our radiance, for renderers that blend it and code
afterwards: with those the picture is ours to the last step.
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
from rnd_runtime.core.sh import SH_COUNT, sh_basis

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Colour = Literal["lit", "albedo"]
Coding = Literal["srgb", "linear"]

SH_0 = 0.28209479177387814  # Y_00, which the formats multiply the first coefficient by
VIEWS = 64  # directions over which the colour's change with the view is fitted: four times the unknowns
BACK_WEIGHT, RIDGE = 0.01, 1e-4  # of views from behind; of the coefficients themselves
FAR = 100.0  # m: from there all of a body is seen in one direction, to half a degree
CELL_SPACINGS = 2.5  # a cell's side, in spacings: the best of 1 to 4
GRID_OFFSETS = (0.0, 0.25, 0.5, 0.75)  # of a cell, along its diagonal: as good as all eight half offsets
SMALLEST_SIGMA = 1e-6  # m: a logarithm is stored


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians ready to be stored.

    Attributes:
        means: [N, 3] m. scales: [N, 3] standard deviations, m. quaternions: [N, 4] wxyz, unit, w ≥ 0.
        opacities: [N] in [0, 1]. normals: [N, 3].
        harmonics: [N, 16, 3] colour coefficients, all but the first zero where the colour is one for all views.
    """

    means: Floats
    scales: Floats
    quaternions: Floats
    opacities: Floats
    normals: Floats
    harmonics: Floats


def are_finite(gaussians: Gaussians) -> NDArray[np.bool_]:
    """[N], which of ``gaussians`` have no number that is not finite."""
    arrays = (array for name, array in vars(gaussians).items() if name != "root_rotation")
    rows = np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
    return np.asarray(np.isfinite(rows).all(axis=1))


def make_splats(gaussians: Gaussians, harmonics: Floats) -> Splats:
    """``gaussians``, all of them finite, with ``harmonics`` [N, 16, 3] from ``fixed_colour`` or
    ``view_dependent_colour``.
    """
    xx, xy, xz, yy, yz, zz = gaussians.covariances.astype(np.float64).T
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    variances, axes = np.linalg.eigh(matrices)
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    return Splats(
        means=gaussians.means.astype(np.float64),
        scales=np.sqrt(np.maximum(variances, SMALLEST_SIGMA**2)),
        quaternions=matrix_to_quaternion(axes),
        opacities=gaussians.opacities.astype(np.float64),
        normals=gaussians.normals.astype(np.float64),
        harmonics=harmonics,
    )


def stored_colours(gaussians: Gaussians, linear: Floats32, coding: Coding, spacing: float) -> Floats:
    """What a file says of colours [N, 3] that are linear radiance; ``spacing`` between Gaussians, m.

    Coding before blending darkens where bright and dark Gaussians mix, by 6/255 in the mean over a person. So
    each coded colour is raised by what that costs in its neighbourhood: code(mean) − mean(code), over cells of
    a grid, the mean of grids set off against each other. That nearly halves the difference (31 → 36 dB).
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
    """Coefficients [N, 16, 3] of one stored colour [N, 3] for every view."""
    harmonics = np.zeros((len(colours), SH_COUNT, 3))
    harmonics[:, 0] = (colours - 0.5) / SH_0
    return harmonics


def view_dependent_colour(gaussians: Gaussians, colours_from: Callable[[Floats], Floats], degree: int) -> Floats:
    """Coefficients [N, 16, 3], zero above ``degree``, of stored colours ``colours_from(eye)`` [N, 3].

    Least squares over views from all around, each weighted for each Gaussian by how much it faces that view:
    what it would look like from behind must not bend what can be seen (5.3 → 0.9 of 255).
    """
    directions = _sphere(VIEWS)
    count = (degree + 1) ** 2
    basis = sh_basis(-directions)[:, :count]  # from the camera to the splat
    weights = np.maximum(gaussians.normals @ directions.T, 0) + BACK_WEIGHT
    centre = gaussians.means.mean(axis=0).astype(np.float64)
    right = np.zeros((len(gaussians.means), count, 3))
    for view, direction in enumerate(directions):
        seen = colours_from(centre + FAR * direction) - 0.5
        right += basis[view][None, :, None] * (weights[:, view, None] * seen)[:, None, :]
    products = (basis[:, :, None] * basis[:, None, :]).reshape(VIEWS, -1)
    left = (weights @ products).reshape(-1, count, count) + RIDGE * np.eye(count)
    harmonics = np.zeros((len(gaussians.means), SH_COUNT, 3))
    harmonics[:, :count] = np.linalg.solve(left, right)
    return harmonics


def turned_over(splats: Splats) -> Splats:
    """Half a turn about Z: Y down as in files trained on COLMAP cameras, which most viewers turn back on loading.

    (x, y, z) → (−x, −y, z) flips the sign of the harmonics that are odd in x and y together.
    """
    flip = np.array([-1.0, -1.0, 1.0])
    probe = np.array([[0.3, 0.5, 0.7]])
    probe /= np.linalg.norm(probe)
    signs = np.sign(sh_basis(probe * flip) * sh_basis(probe))[0]
    w, x, y, z = splats.quaternions.T
    turned = np.stack([-z, -y, x, w], axis=-1)  # (0, 0, 0, 1) ⊗ q
    return Splats(
        splats.means * flip,
        splats.scales,
        np.where(turned[:, :1] < 0, -turned, turned),
        splats.opacities,
        splats.normals * flip,
        splats.harmonics * signs[:, None],
    )


def _cell_means(cell: NDArray[np.intp], weights: Floats32, values: NDArray[np.floating]) -> Floats:
    nothing = np.finfo(np.float64).tiny  # what a cell that nobody sees may weigh
    total = np.maximum(np.bincount(cell, weights), nothing)
    return np.stack([np.bincount(cell, weights * column) / total for column in values.T], axis=1)


def _sphere(count: int) -> Floats:
    """``count`` even directions: points on a golden spiral."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=-1)
