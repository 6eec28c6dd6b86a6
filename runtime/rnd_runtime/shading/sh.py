"""Real spherical harmonics (SH) of degree 3.

Orthonormal, ordered ``l² + l + m``, with the signs of 3D Gaussian splatting (Condon–Shortley): Y_0 = 0.2820948,
Y_1..3 = 0.4886025 · (−y, z, −x), and so on.
"""

from __future__ import annotations

from functools import cache
from math import pi, sqrt
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

SH_DEGREE = 3
SH_COUNT = (SH_DEGREE + 1) ** 2
SH_DEGREES = np.repeat(np.arange(SH_DEGREE + 1), 2 * np.arange(SH_DEGREE + 1) + 1)  # of each function

COSINE_LOBE = np.array([1, 2 / 3, 1 / 4, 0], np.float32)[SH_DEGREES]
"""Factor of max(cos, 0)/π for each function (Ramamoorthi, Hanrahan 2001)."""

_C0 = sqrt(1 / (4 * pi))
_C1 = sqrt(3 / (4 * pi))
_C2_SIDE, _C2_ZONAL = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
_C3_3, _C3_2, _C3_1, _C3_0 = (sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi)))


def sh_columns(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """The sixteen functions at unit directions (x, y, z), each of the shape of ``x``.

    Only ``+ − ×`` are used: accepts numpy arrays, torch tensors, and numba scalars or lanes.
    """
    xx, yy, zz = x * x, y * y, z * z
    return (
        _C0 + 0.0 * x,
        -_C1 * y,
        _C1 * z,
        -_C1 * x,
        _C2_SIDE * (x * y),
        -_C2_SIDE * (y * z),
        _C2_ZONAL * (2.0 * zz - xx - yy),
        -_C2_SIDE * (x * z),
        (0.5 * _C2_SIDE) * (xx - yy),
        -_C3_3 * (y * (3.0 * xx - yy)),
        _C3_2 * (x * y * z),
        -_C3_1 * (y * (4.0 * zz - xx - yy)),
        _C3_0 * (z * (2.0 * zz - 3.0 * xx - 3.0 * yy)),
        -_C3_1 * (x * (4.0 * zz - xx - yy)),
        (0.5 * _C3_2) * (z * (xx - yy)),
        -_C3_3 * (x * (xx - 3.0 * yy)),
    )


def sh_basis(directions: ArrayLike) -> NDArray[Any]:
    """The sixteen functions [..., 16] at unit ``directions`` [..., 3], in the input's precision."""
    directions = np.asarray(directions)
    return np.stack(sh_columns(directions[..., 0], directions[..., 1], directions[..., 2]), axis=-1)


@cache
def sphere_quadrature(count: int) -> tuple[Floats, Floats]:
    """Directions [2·count², 3] and weights (sum 4π), exact up to degree ``2·count − 1``.

    Source: Atkinson, Han 2012, §5.1 (Gauss–Legendre in z, equal steps of azimuth).
    """
    z, weights = np.polynomial.legendre.leggauss(count)
    azimuth = (np.arange(2 * count) + 0.5) * pi / count
    z, azimuth = (grid.ravel() for grid in np.meshgrid(z, azimuth, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    return directions, np.repeat(weights, 2 * count) * (pi / count)


def sh_rotation(rotation: ArrayLike) -> Floats:
    """Matrix M [16, 16] that rotates SH coefficients as ``rotation`` [3, 3] rotates directions.

    With ``rotated = coefficients @ M.T``: ``sh_basis(R d) · rotated = sh_basis(d) · coefficients``. Entries are
    ∫ Y_i(ω) Y_j(Rᵀω) dω, of degree 6, by a quadrature exact up to degree 7.
    """
    return np.asarray(rotation_matrix(*sh_quadrature(), np.array(rotation, np.float64, order="C")))


@cache
def sh_quadrature() -> tuple[Floats, Floats]:
    """Directions [32, 3] of ``sh_rotation``, and the weighted functions there [32, 16]."""
    directions, weights = sphere_quadrature(SH_DEGREE + 1)
    return directions, sh_basis(directions) * weights[:, None]


compiled_sh_columns = njit(sh_columns)


@njit(nogil=True, cache=True)
def rotation_matrix(directions, weighted, rotation):  # type: ignore[no-untyped-def]
    """``sh_rotation`` from its ``sh_quadrature``. Compiled: numpy takes 0.1 ms per frame."""
    matrix = np.zeros((SH_COUNT, SH_COUNT))
    for k in range(len(directions)):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        rotated = compiled_sh_columns(  # at Rᵀω
            rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
            rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
            rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
        )
        for degree in range(SH_DEGREE + 1):
            for i in range(degree * degree, (degree + 1) * (degree + 1)):
                for j in range(degree * degree, (degree + 1) * (degree + 1)):
                    matrix[i, j] += weighted[k, i] * rotated[j]
    return matrix
