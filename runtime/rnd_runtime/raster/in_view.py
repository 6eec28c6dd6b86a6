"""Visibility of Gaussians to a camera, before shading (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import check_shape, floats
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.simd.arithmetic import sqrt
from rnd_runtime.core.simd.memory import load, load_points, store_mask
from rnd_runtime.core.simd.vectors import WIDTH

from .oracle import ALPHA_MIN, DILATION, NEAR
from .project import Pinhole, pinhole

# Standard deviations to α = 1/255 at opacity 1, plus 1 % as camera rotations are orthonormal to 1e-4 only
REACH = 1.01 * math.sqrt(-2 * math.log(ALPHA_MIN))
MIN_OPACITY = np.float32(ALPHA_MIN)
ZERO = np.float32(0)
EVERYTHING = np.float32(-1)  # min cosine without culling
CHUNK = 128 * WIDTH  # Gaussians per unit of parallel work


def in_view(
    means: ArrayLike,
    covariances: ArrayLike,
    opacities: ArrayLike,
    camera: Camera,
    *,
    normals: ArrayLike | None = None,
    cull: float | None = None,
) -> NDArray[np.bool_]:
    """Conservative mask [N] of the Gaussians that reach the image of ``raster.cpu.rasterize``.

    A Gaussian is bounded by a ball of σ = √‖Σ‖ (Frobenius norm). Arguments are as for ``rasterize``.

    Args:
        normals: [N, 3] unit.
        cull: leave out Gaussians whose cosine n·v of normal and direction to the camera is below this. Slightly below 0
            the silhouette stays. Error: docs/performance.md (``rnd-bench frame --cull``).

    Raises:
        InputError: an array has the wrong shape.
    """
    means, covariances, opacities = floats(means), floats(covariances), floats(opacities)
    count = len(means)
    check_shape("means", means, (count, 3))
    check_shape("covariances", covariances, (count, 6))
    check_shape("opacities", opacities, (count,))
    if normals is None or cull is None:
        facing, min_cosine = means, EVERYTHING
    else:
        facing, min_cosine = floats(normals), np.float32(cull)
    check_shape("normals", facing, (count, 3))
    visible: NDArray[np.bool_] = find_in_view(
        means, covariances, opacities, facing, floats(camera.position), min_cosine, pinhole(camera)
    )
    return visible


def visible_to(gaussians: Gaussians, camera: Camera, cull: float | None = None) -> NDArray[np.bool_]:
    """``in_view`` of ``gaussians``."""
    arrays = gaussians.means, gaussians.covariances, gaussians.opacities
    return in_view(*arrays, camera, normals=gaussians.normals, cull=cull)


@njit(inline="always")
def _side(view: Pinhole, axis: int, focal: float, centre: float, low: float, high: float):  # type: ignore[no-untyped-def]
    """Plane of an image's side: x, y, z, constant, and the reach of a ball of σ = 1 m beyond it.

    A point projects to u = f x/z + c, and its ball reaches REACH·√(|m|² σ² + DILATION) px from there, with
    |m|² = (f/z)² (1 + s²) and s the slope bounded by ``Pinhole``. It may touch the pixels u ≥ 0 if
    z u + REACH (f √(1 + s²) σ + z √DILATION) ≥ 0, which is linear in the point.
    """
    r, t = view.rotation, view.translation
    ahead = centre + REACH * math.sqrt(DILATION)
    slope = max(abs(low), abs(high))
    return (
        focal * r[axis, 0] + ahead * r[2, 0],
        focal * r[axis, 1] + ahead * r[2, 1],
        focal * r[axis, 2] + ahead * r[2, 2],
        focal * t[axis] + ahead * t[2],
        REACH * abs(focal) * math.sqrt(1.0 + slope * slope),
    )


@njit(inline="always")
def _ahead(view):  # type: ignore[no-untyped-def]
    """Plane z = NEAR, that a ball's centre must pass."""
    r, t = view.rotation, view.translation
    return r[2, 0], r[2, 1], r[2, 2], t[2] - 0.999 * NEAR, 0.0


@njit(inline="always")
def _sigma(covariances, i):  # type: ignore[no-untyped-def]
    squares = 0.0
    for k in range(6):
        squares += (1.0 if k in (0, 3, 5) else 2.0) * np.float64(covariances[i, k]) ** 2
    return math.sqrt(math.sqrt(squares))


@njit(inline="always")
def _distance(side, x, y, z, reach):  # type: ignore[no-untyped-def]
    return side[0] * x + side[1] * y + side[2] * z + side[3] + side[4] * reach


@njit(inline="always")
def _rounded(side):  # type: ignore[no-untyped-def]
    return (np.float32(side[0]), np.float32(side[1]), np.float32(side[2]), np.float32(side[3]), ZERO)


@njit(inline="always")
def _along(eye, x, y, z, normal):  # type: ignore[no-untyped-def]
    """(eye − p)·n and |eye − p|²."""
    x, y, z = eye[0] - x, eye[1] - y, eye[2] - z
    return x * normal[0] + y * normal[1] + z * normal[2], x * x + y * y + z * z


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def find_in_view(means, covariances, opacities, normals, eye, min_cosine, view):  # type: ignore[no-untyped-def]
    """``in_view`` from ``eye`` [3] with n·v ≥ ``min_cosine``; EVERYTHING ignores normals."""
    visible = np.empty(len(means), np.bool_)
    sides = np.empty((5, 5), np.float64)
    sides[0] = _side(view, 0, view.fx, view.cx, view.low_x, view.high_x)
    sides[1] = _side(view, 0, -view.fx, view.width - view.cx, view.low_x, view.high_x)
    sides[2] = _side(view, 1, view.fy, view.cy, view.low_y, view.high_y)
    sides[3] = _side(view, 1, -view.fy, view.height - view.cy, view.low_y, view.high_y)
    sides[4] = _ahead(view)
    arrays = (means, covariances, opacities, normals)
    for chunk in prange((len(visible) + CHUNK - 1) // CHUNK):
        last = min((chunk + 1) * CHUNK, len(visible))
        _find_in_view(chunk * CHUNK, last, arrays, sides, (eye, min_cosine), visible)
    return visible


@njit(error_model="numpy")
def _find_in_view(first, last, arrays, sides, limits, visible):  # type: ignore[no-untyped-def]
    """Fill ``visible`` from ``first``, a multiple of sixteen, up to ``last``."""
    means, covariances, opacities, normals = arrays
    eye, min_cosine = limits
    culling = min_cosine > EVERYTHING
    # Most centres are inside the image: a float32 test of sixteen at a time; the rest are tested in float64 below
    a, b, c, d, e = (_rounded(sides[0]), _rounded(sides[1]), _rounded(sides[2]), _rounded(sides[3]), _rounded(sides[4]))
    sixteens = last // WIDTH * WIDTH
    for i in range(first, sixteens, WIDTH):
        x, y, z = load_points(means, 3 * i)
        inside = (_distance(a, x, y, z, ZERO) >= ZERO) & (_distance(b, x, y, z, ZERO) >= ZERO)
        inside = inside & (_distance(c, x, y, z, ZERO) >= ZERO) & (_distance(d, x, y, z, ZERO) >= ZERO)
        inside = inside & (_distance(e, x, y, z, ZERO) >= ZERO) & (load(opacities, i) >= MIN_OPACITY)
        if culling:
            along, squared = _along(eye, x, y, z, load_points(normals, 3 * i))
            inside = inside & (along - min_cosine * sqrt(squared) >= ZERO)
        store_mask(visible, i, inside)
    visible[sixteens:last] = False
    for i in range(first, last):
        if visible[i] or not opacities[i] >= MIN_OPACITY:
            continue
        if culling:
            along, squared = _along(eye, means[i, 0], means[i, 1], means[i, 2], normals[i])
            if not along >= min_cosine * np.sqrt(squared):
                continue
        x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        sigma = _sigma(covariances, i)
        reached = True
        for side in sides:
            reached = reached and _distance(side, x, y, z, sigma) >= 0.0
        visible[i] = reached
