"""Projection of Gaussians to ellipses in the image, and its gradient (numba, float64).

An ellipse is stored as the conditional form of its log-density, which float32 rounding cannot make indefinite:

    log2 α(x, y) = peak − fall_y·dy² − fall_x·(dx − shear·dy)²,
    shear = Σxy/Σyy,  fall_y = h/Σyy,  fall_x = h/(Σxx − Σxy²/Σyy),  h = ½·log2(e),  peak = log2(opacity).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera

from .oracle import DILATION, FIELD_OF_VIEW_MARGIN, NEAR

TILE_SHIFT = 4
TILE = 1 << TILE_SHIFT  # pixels; a multiple of the 4×4 block of sixteen lanes
HALF_LOG2_E = 0.5 * math.log2(math.e)
LN2 = math.log(2.0)
LOG2_ALPHA_MIN = -math.log2(255.0)
CHUNK = 1024  # Gaussians projected at a time


class Pinhole(NamedTuple):
    """A camera for a kernel: pixels, and limits of x/z and y/z in the Jacobian."""

    width: int
    height: int
    rotation: NDArray[np.float64]  # [3, 3] world → camera
    translation: NDArray[np.float64]  # [3] m
    fx: float
    fy: float
    cx: float
    cy: float
    low_x: float
    high_x: float
    low_y: float
    high_y: float


def pinhole(camera: Camera) -> Pinhole:
    """The numbers of ``camera``."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    margin_x = FIELD_OF_VIEW_MARGIN * 0.5 * camera.width / fx
    margin_y = FIELD_OF_VIEW_MARGIN * 0.5 * camera.height / fy
    return Pinhole(
        camera.width,
        camera.height,
        np.ascontiguousarray(camera.world_to_camera[:3, :3]),
        np.ascontiguousarray(camera.world_to_camera[:3, 3]),
        fx,
        fy,
        cx,
        cy,
        -cx / fx - margin_x,
        (camera.width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (camera.height - cy) / fy + margin_y,
    )


@njit(inline="always")
def _camera_point(view: Pinhole, means: Any, i: int) -> Any:
    x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    r, t = view.rotation, view.translation
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
    )


@njit(inline="always")
def _clamped_slopes(view: Pinhole, x: float, y: float, z: float) -> Any:
    slope_x = min(max(x / z, view.low_x), view.high_x)
    slope_y = min(max(y / z, view.low_y), view.high_y)
    return slope_x, slope_y


@njit(inline="always")
def _projection_rows(view: Pinhole, slope_x: float, slope_y: float, z: float) -> Any:
    """Rows of M = J·W [2, 3], pixels per world metre."""
    r = view.rotation
    a, b = view.fx / z, view.fy / z
    return (
        a * (r[0, 0] - slope_x * r[2, 0]),
        a * (r[0, 1] - slope_x * r[2, 1]),
        a * (r[0, 2] - slope_x * r[2, 2]),
        b * (r[1, 0] - slope_y * r[2, 0]),
        b * (r[1, 1] - slope_y * r[2, 1]),
        b * (r[1, 2] - slope_y * r[2, 2]),
    )


@njit(inline="always")
def _times_covariance(covariances: Any, i: int, u: float, v: float, w: float) -> Any:
    """Σ·(u, v, w) with Σ given by its upper triangle."""
    xx, xy, xz = np.float64(covariances[i, 0]), np.float64(covariances[i, 1]), np.float64(covariances[i, 2])
    yy, yz, zz = np.float64(covariances[i, 3]), np.float64(covariances[i, 4]), np.float64(covariances[i, 5])
    return xx * u + xy * v + xz * w, xy * u + yy * v + yz * w, xz * u + yz * v + zz * w


@njit(inline="always")
def tile_range(boxes, i):  # type: ignore[no-untyped-def]
    """First and last column and row of tiles: x0, y0, x1, y1."""
    return (boxes[i, 0] >> TILE_SHIFT, boxes[i, 1] >> TILE_SHIFT, boxes[i, 2] >> TILE_SHIFT, boxes[i, 3] >> TILE_SHIFT)


@njit(error_model="numpy")
def project_range(first, last, means, covariances, opacities, features, visible, view, outputs):  # type: ignore[no-untyped-def]
    """Fill rows first … last − 1; ``tiles`` counts the tiles of each, 0 where it is skipped.

    ``visible`` is a mask, or empty for all. NaN fails every guard.
    """
    centers, shapes, boxes, attributes, depths, tiles = outputs
    channels = features.shape[1]
    for i in range(first, last):
        tiles[i] = 0
        if len(visible) > 0 and not visible[i]:
            continue
        opacity = np.float64(opacities[i])
        x, y, z = _camera_point(view, means, i)
        trace = np.float64(covariances[i, 0]) + np.float64(covariances[i, 3]) + np.float64(covariances[i, 5])
        if not (z >= NEAR and z < np.inf and opacity >= 1 / 255 and opacity < np.inf and 0 < trace < np.inf):
            continue
        slope_x, slope_y = _clamped_slopes(view, x, y, z)
        m00, m01, m02, m10, m11, m12 = _projection_rows(view, slope_x, slope_y, z)
        a0, a1, a2 = _times_covariance(covariances, i, m00, m01, m02)
        b0, b1, b2 = _times_covariance(covariances, i, m10, m11, m12)
        xx = m00 * a0 + m01 * a1 + m02 * a2 + DILATION
        xy = m10 * a0 + m11 * a1 + m12 * a2
        yy = m10 * b0 + m11 * b1 + m12 * b2 + DILATION
        if not (0 < yy < np.inf):
            continue
        shear = xy / yy
        conditional = xx - xy * shear
        if not (0 < conditional < np.inf and 0 < xx < np.inf):
            continue
        center_x, center_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        peak = np.float64(math.log2(opacities[i]))
        reach = max(peak - LOG2_ALPHA_MIN, 0.0) / HALF_LOG2_E  # 2·ln(255·opacity)
        reach_x, reach_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
        # Pixel i has its centre at i + ½, with 1e-3 px of margin for rounding. Operands of int() are not negative.
        left, right = max(center_x - reach_x + 0.499, 0.0), min(center_x + reach_x - 0.499, view.width - 1.0)
        top, bottom = max(center_y - reach_y + 0.499, 0.0), min(center_y + reach_y - 0.499, view.height - 1.0)
        if not (left < view.width and top < view.height and right >= 0 and bottom >= 0):
            continue
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = int(left), int(top), int(right), int(bottom)
        if boxes[i, 0] > boxes[i, 2] or boxes[i, 1] > boxes[i, 3]:
            continue
        finite = True
        for c in range(channels):
            finite &= abs(features[i, c]) < np.inf
        if not finite:
            continue
        if attributes.shape[1] > channels:
            for c in range(channels):
                attributes[i, c] = features[i, c]
            attributes[i, channels] = z
        depths[i] = z
        centers[i, 0], centers[i, 1] = center_x, center_y
        shapes[i, 0], shapes[i, 1] = shear, HALF_LOG2_E / yy
        shapes[i, 2], shapes[i, 3] = HALF_LOG2_E / conditional, peak
        x0, y0, x1, y1 = tile_range(boxes, i)
        tiles[i] = (x1 - x0 + 1) * (y1 - y0 + 1)


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def project(means, covariances, opacities, features, visible, view, with_depth):  # type: ignore[no-untyped-def]
    """Project N Gaussians, or those ``visible`` [N] where that is not empty; arrays are float32 and contiguous.

    Returns:
        centers: [N, 2] px, float64.
        shapes: [N, 4] shear, fall_y, fall_x, peak.
        boxes: [N, 4] pixels x0, y0, x1, y1 (inclusive) that α ≥ 1/255 can reach.
        attributes: [N, K] features, then the depth if asked for.
        depths: [N] m, float64.
        slot_starts: [N + 1]; Gaussian i reaches slot_starts[i + 1] − slot_starts[i] tiles. Other rows of a Gaussian
            without tiles are undefined.
    """
    count = means.shape[0]
    centers, shapes = np.empty((count, 2), np.float64), np.empty((count, 4), np.float32)
    boxes, depths = np.empty((count, 4), np.int32), np.empty(count, np.float64)
    attributes = np.empty((count, features.shape[1] + 1), np.float32) if with_depth else features
    slot_starts = np.empty(count + 1, np.int64)
    slot_starts[0] = 0
    outputs = (centers, shapes, boxes, attributes, depths, slot_starts[1:])
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        last = min((chunk + 1) * CHUNK, count)
        project_range(chunk * CHUNK, last, means, covariances, opacities, features, visible, view, outputs)
    for i in range(count):
        slot_starts[i + 1] += slot_starts[i]
    return centers, shapes, boxes, attributes, depths, slot_starts


@njit(error_model="numpy")
def _project_range_backward(first, last, arrays, channels, view, slot_starts, slots, grads):  # type: ignore[no-untyped-def]
    """Gradients of Gaussians first … last − 1 from their summed slots (``.blend.blend_backward``)."""
    means, covariances, opacities = arrays
    grad_means, grad_covariances, grad_opacities, grad_features = grads
    r = view.rotation
    width = slots.shape[1]
    sums = np.empty(width + 1, np.float64)
    for i in range(first, last):
        if slot_starts[i] == slot_starts[i + 1]:
            continue
        sums[:] = 0.0
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            for k in range(width):
                sums[k] += slots[slot, k]
        for c in range(channels):
            grad_features[i, c] = sums[6 + c]
        # Σg, Σg·d, Σg·d², Σg·dy, Σg·dy², Σg·d·dy with g = ∂L/∂log2 α and d = dx − shear·dy
        s, sd, sdd, sy, syy, sdy = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
        grad_depth = sums[6 + channels]  # zero without depth

        x, y, z = _camera_point(view, means, i)
        slope_x, slope_y = _clamped_slopes(view, x, y, z)
        m00, m01, m02, m10, m11, m12 = _projection_rows(view, slope_x, slope_y, z)
        a0, a1, a2 = _times_covariance(covariances, i, m00, m01, m02)
        b0, b1, b2 = _times_covariance(covariances, i, m10, m11, m12)
        xx = m00 * a0 + m01 * a1 + m02 * a2 + DILATION
        xy = m10 * a0 + m11 * a1 + m12 * a2
        yy = m10 * b0 + m11 * b1 + m12 * b2 + DILATION
        shear = xy / yy
        conditional = xx - xy * shear
        fall_x, fall_y = HALF_LOG2_E / conditional, HALF_LOG2_E / yy

        grad_opacities[i] = s / (opacities[i] * LN2)
        grad_shear = 2.0 * fall_x * sdy
        grad_center_x = 2.0 * fall_x * sd
        grad_center_y = 2.0 * fall_y * sy - shear * grad_center_x
        grad_xx = fall_x / conditional * sdd
        half_xy = 0.5 * grad_shear / yy - shear * grad_xx
        grad_yy = (fall_y * syy - shear * grad_shear) / yy + shear * shear * grad_xx

        # Σ' = M Σ Mᵀ with rows m0, m1 of M; an off-diagonal element of Σ counts twice
        p0, p1, p2 = (grad_xx * m00 + half_xy * m10, grad_xx * m01 + half_xy * m11, grad_xx * m02 + half_xy * m12)
        q0, q1, q2 = (half_xy * m00 + grad_yy * m10, half_xy * m01 + grad_yy * m11, half_xy * m02 + grad_yy * m12)
        grad_covariances[i, 0] = m00 * p0 + m10 * q0
        grad_covariances[i, 1] = 2.0 * (m00 * p1 + m10 * q1)
        grad_covariances[i, 2] = 2.0 * (m00 * p2 + m10 * q2)
        grad_covariances[i, 3] = m01 * p1 + m11 * q1
        grad_covariances[i, 4] = 2.0 * (m01 * p2 + m11 * q2)
        grad_covariances[i, 5] = m02 * p2 + m12 * q2
        g00, g01, g02 = grad_xx * a0 + half_xy * b0, grad_xx * a1 + half_xy * b1, grad_xx * a2 + half_xy * b2
        g10, g11, g12 = half_xy * a0 + grad_yy * b0, half_xy * a1 + grad_yy * b1, half_xy * a2 + grad_yy * b2
        # m0 = fx/z·(r0 − slope_x·r2); a clamped slope is constant
        along_x = 2.0 * (g00 * r[2, 0] + g01 * r[2, 1] + g02 * r[2, 2])
        along_y = 2.0 * (g10 * r[2, 0] + g11 * r[2, 1] + g12 * r[2, 2])
        scaling = 2.0 * (g00 * m00 + g01 * m01 + g02 * m02 + g10 * m10 + g11 * m11 + g12 * m12)
        slope_moves_x = 1.0 if view.low_x <= x / z <= view.high_x else 0.0
        slope_moves_y = 1.0 if view.low_y <= y / z <= view.high_y else 0.0
        grad_x = view.fx / z * (grad_center_x - slope_moves_x * along_x / z)
        grad_y = view.fy / z * (grad_center_y - slope_moves_y * along_y / z)
        grad_z = grad_depth - (scaling + grad_x * x + grad_y * y) / z
        for k in range(3):
            grad_means[i, k] = r[0, k] * grad_x + r[1, k] * grad_y + r[2, k] * grad_z


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def project_backward(means, covariances, opacities, channels, view, slot_starts, slots):  # type: ignore[no-untyped-def]
    """Gradients of means [N, 3], covariances [N, 6], opacities [N] and features [N, C]; zero for skipped Gaussians.

    Sums each Gaussian's ``slots`` [P, 6 + K] of ``.blend.blend_backward`` in a fixed order.
    """
    count = means.shape[0]
    grads = (
        np.zeros((count, 3), np.float32),
        np.zeros((count, 6), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, channels), np.float32),
    )
    arrays = (means, covariances, opacities)
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        last = min((chunk + 1) * CHUNK, count)
        _project_range_backward(chunk * CHUNK, last, arrays, channels, view, slot_starts, slots, grads)
    return grads
