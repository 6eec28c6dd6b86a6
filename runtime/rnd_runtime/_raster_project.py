"""From Gaussians in the world to ellipses sorted into tiles, and the way back for gradients (numba, float64).

An ellipse is kept as the conditional form of its log-density, which no float32 rounding can make indefinite:

    log2 α(x, y) = peak − fall_y·dy² − fall_x·(dx − shear·dy)²,
    shear = Σxy/Σyy,  fall_y = h/Σyy,  fall_x = h/(Σxx − Σxy²/Σyy),  h = ½·log2(e),  peak = log2(opacity).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from .camera import Camera

TILE = 16  # pixels; a multiple of the 4×4 block that fills sixteen lanes
NEAR = 0.01  # m
DILATION = 0.3  # px², 3DGS's low-pass filter
FIELD_OF_VIEW_MARGIN = 0.3  # of half the field of view: gsplat's limit for x/z and y/z in the Jacobian
HALF_LOG2_E = 0.5 * math.log2(math.e)
RADIX_BITS = 11


class View(NamedTuple):
    """A camera as numbers for a kernel: pixels, and limits of x/z and y/z where the Jacobian is taken."""

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


def view_of(camera: Camera) -> View:
    """The numbers of ``camera``; skew in K is not modelled."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    margin_x = FIELD_OF_VIEW_MARGIN * 0.5 * camera.width / fx
    margin_y = FIELD_OF_VIEW_MARGIN * 0.5 * camera.height / fy
    return View(
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


class Splats(NamedTuple):
    """What the blending kernels read. P counts (Gaussian, tile) pairs; pairs of a tile lie front to back."""

    centers: NDArray[np.float64]  # [N, 2] px
    shapes: NDArray[np.float32]  # [N, 4] shear, fall_y, fall_x, peak
    boxes: NDArray[np.int32]  # [N, 4] pixels x0, y0, x1, y1 (inclusive) that α ≥ 1/255 can reach
    attributes: NDArray[np.float32]  # [N, K] features, then the depth when it is asked for
    tile_starts: NDArray[np.int64]  # [tiles + 1] into the pairs
    pair_gaussians: NDArray[np.int32]  # [P]
    pair_slots: NDArray[np.int32]  # [P] where the pair's gradient goes
    slot_starts: NDArray[np.int64]  # [N + 1]: the slots of Gaussian i are slot_starts[i] : slot_starts[i + 1]


@njit(inline="always")
def _camera_point(view: View, means: Any, i: int) -> Any:
    x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    r, t = view.rotation, view.translation
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
    )


@njit(inline="always")
def _clamped_slopes(view: View, x: float, y: float, z: float) -> Any:
    slope_x = min(max(x / z, view.low_x), view.high_x)
    slope_y = min(max(y / z, view.low_y), view.high_y)
    return slope_x, slope_y


@njit(inline="always")
def _projection_rows(view: View, slope_x: float, slope_y: float, z: float) -> Any:
    """Rows of M = J·W [2, 3]: how pixels move with world metres."""
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
    """Σ·(u, v, w) with Σ from its upper triangle."""
    xx, xy, xz = np.float64(covariances[i, 0]), np.float64(covariances[i, 1]), np.float64(covariances[i, 2])
    yy, yz, zz = np.float64(covariances[i, 3]), np.float64(covariances[i, 4]), np.float64(covariances[i, 5])
    return xx * u + xy * v + xz * w, xy * u + yy * v + yz * w, xz * u + yz * v + zz * w


@njit
def _project_one(i, means, covariances, opacities, features, view, splats, depths):  # type: ignore[no-untyped-def]
    """Fill row i; returns the number of tiles it reaches, 0 if it is not drawn. NaN fails every guard."""
    centers, shapes, boxes, attributes = splats
    opacity = np.float64(opacities[i])
    x, y, z = _camera_point(view, means, i)
    trace = np.float64(covariances[i, 0]) + np.float64(covariances[i, 3]) + np.float64(covariances[i, 5])
    if not (z >= NEAR and z < np.inf and opacity >= 1 / 255 and opacity < np.inf and 0 < trace < np.inf):
        return 0
    slope_x, slope_y = _clamped_slopes(view, x, y, z)
    m00, m01, m02, m10, m11, m12 = _projection_rows(view, slope_x, slope_y, z)
    a0, a1, a2 = _times_covariance(covariances, i, m00, m01, m02)
    b0, b1, b2 = _times_covariance(covariances, i, m10, m11, m12)
    xx = m00 * a0 + m01 * a1 + m02 * a2 + DILATION
    xy = m10 * a0 + m11 * a1 + m12 * a2
    yy = m10 * b0 + m11 * b1 + m12 * b2 + DILATION
    if not (0 < yy < np.inf):
        return 0
    shear = xy / yy
    conditional = xx - xy * shear
    if not (0 < conditional < np.inf and 0 < xx < np.inf):
        return 0
    center_x, center_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    reach = 2.0 * math.log(255.0 * opacity)
    reach_x, reach_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
    # pixel i has its centre at i + ½; a thousandth of a pixel keeps rounding from losing one on the border
    x0 = max(center_x - reach_x - 0.501, -1.0)
    y0 = max(center_y - reach_y - 0.501, -1.0)
    x1 = min(center_x + reach_x - 0.499, view.width - 1.0)
    y1 = min(center_y + reach_y - 0.499, view.height - 1.0)
    if not (x1 >= 0 and y1 >= 0 and x0 <= view.width - 1.0 and y0 <= view.height - 1.0):
        return 0
    left, top = max(math.ceil(x0), 0), max(math.ceil(y0), 0)
    right, bottom = math.floor(x1), math.floor(y1)
    if left > right or top > bottom:
        return 0
    channels = features.shape[1]
    finite = np.float32(0)
    for c in range(channels):
        attributes[i, c] = features[i, c]
        finite += features[i, c] * np.float32(0)
    if not (finite == 0):  # noqa: SIM201 (NaN must fail)
        return 0
    if attributes.shape[1] > channels:
        attributes[i, channels] = z
    depths[i] = z
    centers[i, 0], centers[i, 1] = center_x, center_y
    shapes[i, 0], shapes[i, 1] = shear, HALF_LOG2_E / yy
    shapes[i, 2], shapes[i, 3] = HALF_LOG2_E / conditional, math.log2(opacity)
    boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = left, top, right, bottom
    return (right // TILE - left // TILE + 1) * (bottom // TILE - top // TILE + 1)


@njit
def _front_to_back(depths, slot_starts):  # type: ignore[no-untyped-def]
    """Indices of the drawn Gaussians by depth, equal depths by index.

    A stable radix sort of 32-bit keys that span just the visible range: 1 m of depth is cut into 0.2 nm,
    where float32 depths (60 nm at 1 m) would cost 50 dB.
    """
    count = 0
    near, far = np.inf, -np.inf
    for i in range(depths.size):
        if slot_starts[i + 1] > slot_starts[i]:
            count += 1
            near, far = min(near, depths[i]), max(far, depths[i])
    scale = 4294967295.0 / (far - near) if far > near else 0.0
    keys, order = np.empty(count, np.uint32), np.empty(count, np.int32)
    other_keys, other_order = np.empty(count, np.uint32), np.empty(count, np.int32)
    passes = (32 + RADIX_BITS - 1) // RADIX_BITS
    counts = np.zeros((passes, 1 << RADIX_BITS), np.int32)
    mask = np.uint32((1 << RADIX_BITS) - 1)
    k = 0
    for i in range(depths.size):
        if slot_starts[i + 1] > slot_starts[i]:
            key = np.uint32(np.int64((depths[i] - near) * scale))
            keys[k], order[k] = key, i
            k += 1
            for p in range(passes):
                counts[p, (key >> np.uint32(p * RADIX_BITS)) & mask] += 1
    for p in range(passes):
        start = 0
        for digit in range(1 << RADIX_BITS):
            start, counts[p, digit] = start + counts[p, digit], start
        shift = np.uint32(p * RADIX_BITS)
        for k in range(count):
            digit = (keys[k] >> shift) & mask
            place = counts[p, digit]
            counts[p, digit] = place + 1
            other_keys[place], other_order[place] = keys[k], order[k]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


@njit
def _into_tiles(order, boxes, slot_starts, tiles_x, tiles_y):  # type: ignore[no-untyped-def]
    """Counting sort of the (Gaussian, tile) pairs into tiles; within a tile they keep ``order``."""
    starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for g in order:
        for ty in range(boxes[g, 1] // TILE, boxes[g, 3] // TILE + 1):
            for tx in range(boxes[g, 0] // TILE, boxes[g, 2] // TILE + 1):
                starts[ty * tiles_x + tx + 1] += 1
    for tile in range(tiles_x * tiles_y):
        starts[tile + 1] += starts[tile]
    cursor = starts[:-1].copy()
    pair_gaussians, pair_slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    for g in order:
        slot = slot_starts[g]
        for ty in range(boxes[g, 1] // TILE, boxes[g, 3] // TILE + 1):
            for tx in range(boxes[g, 0] // TILE, boxes[g, 2] // TILE + 1):
                place = cursor[ty * tiles_x + tx]
                cursor[ty * tiles_x + tx] = place + 1
                pair_gaussians[place], pair_slots[place] = g, slot
                slot += 1
    return starts, pair_gaussians, pair_slots


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def project(means, covariances, opacities, features, view, with_depth):  # type: ignore[no-untyped-def]
    """Project, sort and bin. Arrays are float32 and contiguous; returns :class:`Splats`."""
    count = means.shape[0]
    width = features.shape[1] + (1 if with_depth else 0)
    centers, shapes = np.empty((count, 2), np.float64), np.empty((count, 4), np.float32)
    boxes, attributes = np.empty((count, 4), np.int32), np.empty((count, width), np.float32)
    depths, slot_starts = np.empty(count, np.float64), np.empty(count + 1, np.int64)
    slot_starts[0] = 0
    rows = (centers, shapes, boxes, attributes)
    for i in prange(count):
        slot_starts[i + 1] = _project_one(i, means, covariances, opacities, features, view, rows, depths)
    for i in range(count):
        slot_starts[i + 1] += slot_starts[i]
    tiles_x, tiles_y = (view.width + TILE - 1) // TILE, (view.height + TILE - 1) // TILE
    # before the sort the differences of slot_starts tell who is drawn
    order = _front_to_back(depths, slot_starts)
    starts, pair_gaussians, pair_slots = _into_tiles(order, boxes, slot_starts, tiles_x, tiles_y)
    return Splats(centers, shapes, boxes, attributes, starts, pair_gaussians, pair_slots, slot_starts)


@njit
def _project_one_backward(i, means, covariances, opacity, view, moments, grads):  # type: ignore[no-untyped-def]
    """Chain rule from the summed moments of Gaussian i (see ``_raster_blend``) to its world parameters.

    ``moments``: Σg, Σg·d, Σg·d², Σg·dy, Σg·dy², Σg·d·dy with g = ∂L/∂log2 α, d = dx − shear·dy; then ∂L/∂z.
    """
    grad_means, grad_covariances, grad_opacities = grads
    s, sd, sdd, sy, syy, sdy, grad_depth = moments
    r = view.rotation
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

    grad_opacities[i] = s / (opacity * math.log(2.0))
    grad_shear = 2.0 * fall_x * sdy
    grad_center_x = 2.0 * fall_x * sd
    grad_center_y = 2.0 * fall_y * sy - shear * grad_center_x
    grad_conditional = fall_x / conditional * sdd
    grad_xx = grad_conditional
    grad_xy = grad_shear / yy - 2.0 * shear * grad_conditional
    grad_yy = fall_y / yy * syy - shear / yy * grad_shear + shear * shear * grad_conditional

    # Σ' = M Σ Mᵀ with M's rows m0, m1
    grad_covariances[i, 0] = grad_xx * m00 * m00 + grad_xy * m00 * m10 + grad_yy * m10 * m10
    grad_covariances[i, 3] = grad_xx * m01 * m01 + grad_xy * m01 * m11 + grad_yy * m11 * m11
    grad_covariances[i, 5] = grad_xx * m02 * m02 + grad_xy * m02 * m12 + grad_yy * m12 * m12
    half = 0.5 * grad_xy
    grad_covariances[i, 1] = 2.0 * (
        grad_xx * m00 * m01 + half * (m00 * m11 + m01 * m10) + grad_yy * m10 * m11
    )
    grad_covariances[i, 2] = 2.0 * (
        grad_xx * m00 * m02 + half * (m00 * m12 + m02 * m10) + grad_yy * m10 * m12
    )
    grad_covariances[i, 4] = 2.0 * (
        grad_xx * m01 * m02 + half * (m01 * m12 + m02 * m11) + grad_yy * m11 * m12
    )
    g00, g01, g02 = (
        2.0 * grad_xx * a0 + grad_xy * b0,
        2.0 * grad_xx * a1 + grad_xy * b1,
        2.0 * grad_xx * a2 + grad_xy * b2,
    )
    g10, g11, g12 = (
        2.0 * grad_yy * b0 + grad_xy * a0,
        2.0 * grad_yy * b1 + grad_xy * a1,
        2.0 * grad_yy * b2 + grad_xy * a2,
    )
    # m0 = fx/z·(r0 − slope_x·r2); a clamped slope is constant
    along = g00 * r[2, 0] + g01 * r[2, 1] + g02 * r[2, 2]
    grad_slope_x = -view.fx / z * along if view.low_x <= x / z <= view.high_x else 0.0
    along = g10 * r[2, 0] + g11 * r[2, 1] + g12 * r[2, 2]
    grad_slope_y = -view.fy / z * along if view.low_y <= y / z <= view.high_y else 0.0
    scaling = g00 * m00 + g01 * m01 + g02 * m02 + g10 * m10 + g11 * m11 + g12 * m12
    grad_x = (view.fx * grad_center_x + grad_slope_x) / z
    grad_y = (view.fy * grad_center_y + grad_slope_y) / z
    grad_z = grad_depth - scaling / z - (grad_x * x + grad_y * y) / z
    for k in range(3):
        grad_means[i, k] = r[0, k] * grad_x + r[1, k] * grad_y + r[2, k] * grad_z


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def project_backward(means, covariances, opacities, channels, view, splats, slots, threads):  # type: ignore[no-untyped-def]
    """Sum each Gaussian's slots in their fixed order and take the sums back to the world.

    ``slots`` [P, 6 + K] as ``_raster_blend.blend_backward`` fills them. Returns gradients of means [N, 3],
    covariances [N, 6], opacities [N] and features [N, C], zero where a Gaussian was not drawn.
    """
    count, width = means.shape[0], slots.shape[1]
    grad_means, grad_covariances = np.zeros((count, 3), np.float32), np.zeros((count, 6), np.float32)
    grad_opacities, grad_features = np.zeros(count, np.float32), np.zeros((count, channels), np.float32)
    grads = (grad_means, grad_covariances, grad_opacities)
    for thread in prange(threads):
        sums = np.empty(width + 1, np.float64)
        sums[width] = 0.0  # ∂L/∂z where no depth was asked for
        for i in range(count * thread // threads, count * (thread + 1) // threads):
            first, last = splats.slot_starts[i], splats.slot_starts[i + 1]
            if first == last:
                continue
            sums[:width] = 0.0
            for slot in range(first, last):
                for k in range(width):
                    sums[k] += slots[slot, k]
            for c in range(channels):
                grad_features[i, c] = sums[6 + c]
            moments = (sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6 + channels])
            _project_one_backward(i, means, covariances, np.float64(opacities[i]), view, moments, grads)
    return grad_means, grad_covariances, grad_opacities, grad_features
