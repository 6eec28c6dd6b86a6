"""Posing of all Gaussians in one compiled pass (numba, sixteen lanes).

Network outputs at M nodes are interpolated for each of N Gaussians; A is the blended bone transform::

    fields = Σ_k weight_k · node fields[neighbour_k]          Δ logits, Δx and Δr before tanh, visibility
    W      = softmax(log W_template + Δ logits)
    A      = Σ_j W_j B_j = [A_R | A_T]
    t      = min(1, |cofactor(A_R) u| / |A_R u|²)             u: the limb's axis; t < 1 where it is twisted
    κ      = share · (Newton–Schulz factor of t − 1)          widens what a twist has pinched
    mean   = A_R (x_c + max_offset · tanh Δx + κ lever) + A_T
    Σ      = F Fᵀ + floor² I,  F = A_R · C · R(tanh Δr) · (R S)   R(v): the quaternion normalize(1, v/2)
    normal = normalize((cofactor(A_R) + fallback · A_R) (n_c + κ u (u·n_c)))      C = (1 + κ) I − κ u uᵀ

The float64 reference is ``posing.reference``.

The template gives a Gaussian a few joints above a floor of 1e-6. A is summed exactly over these joints; the floor's
part is summed over all joints at the nodes and interpolated. With c_k the node's max Δ logit and c = Σ_k weight_k c_k::

    A ∝ Σ_{j of the template} (W_template,j / floor − 1) e^{Δ_j − c} B_j + Σ_k weight_k Σ_j e^{Δ_kj − c_k} B_j

The second sum is approximate: Gaussians of a trained avatar move by 0.6 µm (mean), 0.2 mm (max).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rnd_runtime.core.simd.arithmetic import exp2, lanes, select, sqrt
from rnd_runtime.core.simd.memory import aligned_floats, broadcast, load, prefetch, prefetch_to_write, store, transpose
from rnd_runtime.core.simd.vectors import WIDTH
from rnd_runtime.shading.sh import SH_COUNT

Floats32 = NDArray[np.float32]

_CHUNK = 256  # Gaussians per unit of parallel work
_LOG2_E = np.float32(np.log2(np.e))
_MIN_EXPONENT = np.float32(-126)  # of a normal float32
_MAX_TANH = np.float32(9)  # tanh is 1 in float32 beyond it
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
SHORTEST = np.float32(1e-9)  # min length of a normal in its normalisation
TWIST_STEPS = 3  # of Newton–Schulz, s → s (3 − s²)/2 on s = √t: two leave 0.54 of a limb at 150°, three 0.73
SMALLEST_SQUARE = np.float32(1e-6)  # min |A_R u|²
NEVER = np.float32(-1e30)  # log of weight 0
# First component of each part of a Gaussian's rest pose; COMPONENTS: their number
POINTS, FACTORS, NORMALS, LIMBS, FLOOR, COMPONENTS = (0, 3, 12, 15, 22, 23)
# A node's fields: Σ_j e^(Δ_j − c) B_j [12], Σ_j e^(Δ_j − c), c; offsets [16]; visibility [16]; Δ_j
_SUM, _MAX_LOGIT, _OFFSETS, _VISIBILITY, _LOGITS = (12, 13, WIDTH, 2 * WIDTH, 3 * WIDTH)


class PosedArrays(NamedTuple):
    """Posed Gaussians in the frame of the bones; see ``core.gaussians.Gaussians``."""

    means: Floats32  # [N, 3] m
    covariances: Floats32  # [N, 6] m²
    normals: Floats32  # [N, 3] unit
    visibility: Floats32  # [N, 16]


@njit(inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """e^x, clamped below; NaN stays NaN, as every comparison with it fails."""
    power = x * _LOG2_E
    return exp2(select(power < _MIN_EXPONENT, _MIN_EXPONENT, power))


@njit(inline="always")
def _tanh(x):  # type: ignore[no-untyped-def]
    """tanh with an absolute error of 1e-7."""
    x = select(x > _MAX_TANH, _MAX_TANH, x)
    x = select(x < -_MAX_TANH, -_MAX_TANH, x)
    return lanes(_ONE) - lanes(_TWO) / (_exp(x * _TWO) + _ONE)


@njit(error_model="numpy", nogil=True, cache=True)
def pose_kernel(rest, nodes, bones, limits, count):  # type: ignore[no-untyped-def]
    """``PosedArrays`` of the ``count`` Gaussians of ``rest``; arguments as made by ``RestPose``."""
    logits, offsets, visibility = nodes
    rows = bone_rows(bones)
    fields = node_fields(logits, offsets, visibility, rows)
    padded = len(rest.neighbours)
    means, covariances = np.empty((padded, 3), np.float32), np.empty((padded, 6), np.float32)
    normals, visibility_out = np.empty((padded, 3), np.float32), np.empty((padded, SH_COUNT), np.float32)
    _pose(fields, rest, rows, limits, PosedArrays(means, covariances, normals, visibility_out))
    return PosedArrays(means[:count], covariances[:count], normals[:count], visibility_out[:count])


@njit(error_model="numpy", nogil=True, cache=True)
def bone_rows(bones):  # type: ignore[no-untyped-def]
    """[J, 16]: each joint's B row by row, 1 and zeros."""
    rows = np.zeros((len(bones), WIDTH), np.float32)
    for j in range(len(bones)):
        for k in range(_SUM):
            rows[j, k] = bones[j, k // 4, k % 4]
        rows[j, _SUM] = _ONE
    return rows


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def node_fields(logits, offsets, visibility, bones):  # type: ignore[no-untyped-def]
    """Fields [M, 48 + J padded to a multiple of 16] of all nodes."""
    joints = len(bones)
    columns = _LOGITS + (joints + WIDTH - 1) // WIDTH * WIDTH
    fields = np.zeros((len(offsets), columns), np.float32)
    for m in prange(len(offsets)):
        max_logit = logits[m, 0]
        for j in range(joints):
            fields[m, _LOGITS + j] = logits[m, j]
            max_logit = max(max_logit, logits[m, j])
        blend = lanes(_ZERO)
        for j in range(joints):
            blend += _exp(lanes(logits[m, j] - max_logit)) * load(bones, j * WIDTH)
        store(fields, m * columns, blend)
        fields[m, _MAX_LOGIT] = max_logit
        for k in range(offsets.shape[1]):
            fields[m, _OFFSETS + k] = offsets[m, k]
        for k in range(visibility.shape[1]):
            fields[m, _VISIBILITY + k] = visibility[m, k]
    return fields


@njit(error_model="numpy")
def _interpolate_sixteen(first, fields, rest, blends, offsets, visibility, logits_16):  # type: ignore[no-untyped-def]
    """Interpolate fields of sixteen Gaussians, one per row of 16.

    Fills ``blends`` and ``offsets`` [16, 16], their rows of ``visibility``, and Δ logits − c in ``logits_16``.
    """
    width, logit_count = fields.shape[1], len(logits_16) // WIDTH
    for lane in range(WIDTH):
        i = first + lane
        blend, offset, visible = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
        for k in range(rest.neighbours.shape[1]):
            at, weight = rest.neighbours[i, k] * width, rest.weights[i, k]
            blend += weight * load(fields, at)
            offset += weight * load(fields, at + _OFFSETS)
            visible += weight * load(fields, at + _VISIBILITY)
        store(blends, lane * WIDTH, blend)
        store(offsets, lane * WIDTH, offset)
        store(visibility, i * WIDTH, visible)
        for column in range(0, logit_count, WIDTH):
            change = lanes(_ZERO) - broadcast(blends, lane * WIDTH + _MAX_LOGIT)
            for k in range(rest.neighbours.shape[1]):
                at = rest.neighbours[i, k] * width + _LOGITS + column
                change += rest.weights[i, k] * load(fields, at)
            store(logits_16, lane * logit_count + column, change)


@njit(error_model="numpy")
def _blend_sixteen(first, rest, bones, rows, logits_16, joint_weights, blend):  # type: ignore[no-untyped-def]
    """A [3, 4] by component of sixteen Gaussians from interpolated ``rows`` and ``logits_16``.

    NaN where a logit is NaN or +∞, as in a softmax. ``joint_weights`` [slots, 16] is scratch.
    """
    width = len(logits_16) // WIDTH
    start, end = WIDTH * rest.starts[first // WIDTH], WIDTH * rest.starts[first // WIDTH + 1]
    for at in range(start, end, WIDTH):
        for lane in range(WIDTH):
            joint_weights[at - start + lane] = logits_16[lane * width + rest.joints[at + lane]]
        logs = load(rest.logs, at)
        weights = _exp(load(joint_weights, at - start) + logs)
        store(joint_weights, at - start, select(logs < _HALF * NEVER, _ZERO, weights))
    for lane in range(WIDTH):
        row = rest.components[first * COMPONENTS + FLOOR * WIDTH + lane] * load(rows, lane * WIDTH)
        for at in range(start + lane, end, WIDTH):
            row += joint_weights[at - start] * load(bones, rest.joints[at] * WIDTH)
        store(rows, lane * WIDTH, row)
    transpose(rows, blend)
    scale = _ONE / load(blend, _SUM * WIDTH)
    for at in range(0, _SUM * WIDTH, WIDTH):
        store(blend, at, load(blend, at) * scale)


@njit
def _row(x, y, z, b):  # type: ignore[no-untyped-def]
    """(x, y, z) B."""
    return x * b[0] + y * b[3] + z * b[6], x * b[1] + y * b[4] + z * b[7], x * b[2] + y * b[5] + z * b[8]


@njit
def _apply(a, x, y, z):  # type: ignore[no-untyped-def]
    """A (x, y, z)."""
    return a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z


@njit
def _cofactors(a):  # type: ignore[no-untyped-def]
    """det(A) A⁻ᵀ, finite for any A."""
    return (
        a[4] * a[8] - a[5] * a[7],
        a[5] * a[6] - a[3] * a[8],
        a[3] * a[7] - a[4] * a[6],
        a[7] * a[2] - a[8] * a[1],
        a[8] * a[0] - a[6] * a[2],
        a[6] * a[1] - a[7] * a[0],
        a[1] * a[5] - a[2] * a[4],
        a[2] * a[3] - a[0] * a[5],
        a[0] * a[4] - a[1] * a[3],
    )


@njit
def _rotated_rows(x, y, z, f):  # type: ignore[no-untyped-def]
    """R F for R of the quaternion normalize(1, v/2), v = (x, y, z); F row by row."""
    x, y, z = _HALF * x, _HALF * y, _HALF * z
    scale = _TWO / (_ONE + x * x + y * y + z * z)
    first = _row(_ONE - scale * (y * y + z * z), scale * (x * y - z), scale * (x * z + y), f)
    second = _row(scale * (x * y + z), _ONE - scale * (x * x + z * z), scale * (y * z - x), f)
    third = _row(scale * (x * z - y), scale * (y * z + x), _ONE - scale * (x * x + y * y), f)
    return first + second + third


@njit
def _widening(a, cofactors, axis, share):  # type: ignore[no-untyped-def]
    """κ of a blend A about a limb's axis."""
    x, y, z = _apply(a, axis[0], axis[1], axis[2])
    length_squared = x * x + y * y + z * z
    length_squared = select(length_squared > SMALLEST_SQUARE, length_squared, SMALLEST_SQUARE)
    x, y, z = _apply(cofactors, axis[0], axis[1], axis[2])
    twist_ratio = sqrt(x * x + y * y + z * z) / length_squared
    twist_ratio = select(twist_ratio > _ONE, _ONE, twist_ratio)
    factor = lanes(_ONE)
    for _ in range(TWIST_STEPS):
        step = _HALF * (_THREE - twist_ratio)
        factor, twist_ratio = factor * step, twist_ratio * step * step
    return share * (factor - _ONE)


@njit
def _load3(array, first, i, stride):  # type: ignore[no-untyped-def]
    """Components ``first`` … ``first + 2`` of sixteen Gaussians from ``i`` on, ``stride`` apart."""
    at = first * stride + i
    return load(array, at), load(array, at + stride), load(array, at + 2 * stride)


@njit
def _pose_sixteen(i, blend, offset, rest, limits, out):  # type: ignore[no-untyped-def]
    """Means, covariances and normals of Gaussians i … i + 15, twelve rows of sixteen in ``out``.

    ``blend`` holds A and ``offset`` the bounded offsets and rotations, both by component.
    """
    max_offset, floor, fallback = limits
    at, stride = i * COMPONENTS, WIDTH
    first, second, third = (_load3(blend, 0, 0, WIDTH), _load3(blend, 4, 0, WIDTH), _load3(blend, 8, 0, WIDTH))
    a = first + second + third
    cofactors = _cofactors(a)
    axis, lever = _load3(rest.components, LIMBS, at, stride), _load3(rest.components, LIMBS + 3, at, stride)
    kappa = _widening(a, cofactors, axis, load(rest.components, (LIMBS + 6) * stride + at))

    point, shift = _load3(rest.components, POINTS, at, stride), _load3(offset, 0, 0, WIDTH)
    x = point[0] + max_offset * shift[0] + kappa * lever[0]
    y = point[1] + max_offset * shift[1] + kappa * lever[1]
    z = point[2] + max_offset * shift[2] + kappa * lever[2]
    x, y, z = _apply(a, x, y, z)
    store(out, 0, x + load(blend, 3 * WIDTH))
    store(out, WIDTH, y + load(blend, 7 * WIDTH))
    store(out, 2 * WIDTH, z + load(blend, 11 * WIDTH))

    f = (
        _load3(rest.components, FACTORS, at, stride)
        + _load3(rest.components, FACTORS + 3, at, stride)
        + _load3(rest.components, FACTORS + 6, at, stride)
    )
    rotation = _load3(offset, 3, 0, WIDTH)
    f = _rotated_rows(rotation[0], rotation[1], rotation[2], f)
    widened = _ONE + kappa
    x, y, z = _row(kappa * axis[0], kappa * axis[1], kappa * axis[2], f)
    row0 = widened * f[0] - axis[0] * x, widened * f[1] - axis[0] * y, widened * f[2] - axis[0] * z
    row1 = widened * f[3] - axis[1] * x, widened * f[4] - axis[1] * y, widened * f[5] - axis[1] * z
    row2 = widened * f[6] - axis[2] * x, widened * f[7] - axis[2] * y, widened * f[8] - axis[2] * z
    f = row0 + row1 + row2
    f0, f1, f2 = _row(a[0], a[1], a[2], f)
    f3, f4, f5 = _row(a[3], a[4], a[5], f)
    f6, f7, f8 = _row(a[6], a[7], a[8], f)
    store(out, 3 * WIDTH, f0 * f0 + f1 * f1 + f2 * f2 + floor)
    store(out, 4 * WIDTH, f0 * f3 + f1 * f4 + f2 * f5)
    store(out, 5 * WIDTH, f0 * f6 + f1 * f7 + f2 * f8)
    store(out, 6 * WIDTH, f3 * f3 + f4 * f4 + f5 * f5 + floor)
    store(out, 7 * WIDTH, f3 * f6 + f4 * f7 + f5 * f8)
    store(out, 8 * WIDTH, f6 * f6 + f7 * f7 + f8 * f8 + floor)

    normal = _load3(rest.components, NORMALS, at, stride)
    along = kappa * (axis[0] * normal[0] + axis[1] * normal[1] + axis[2] * normal[2])
    nx, ny, nz = normal[0] + axis[0] * along, normal[1] + axis[1] * along, normal[2] + axis[2] * along
    x, y, z = _apply(cofactors, nx, ny, nz)
    u, v, w = _apply(a, nx, ny, nz)
    x, y, z = x + fallback * u, y + fallback * v, z + fallback * w
    length = sqrt(x * x + y * y + z * z)
    scale = _ONE / select(length > SHORTEST, length, SHORTEST)
    store(out, 9 * WIDTH, x * scale)
    store(out, 10 * WIDTH, y * scale)
    store(out, 11 * WIDTH, z * scale)


@njit(inline="always")
def _prefetch_sixteen(first, rest, posed):  # type: ignore[no-untyped-def]
    """Prefetch what a later sixteen reads and writes; saves 1/7 of the time."""
    neighbours = rest.neighbours.shape[1]
    for line in range(0, COMPONENTS * WIDTH, WIDTH):
        prefetch(rest.components, first * COMPONENTS + line)
    for line in range(0, neighbours * WIDTH, WIDTH):
        prefetch(rest.neighbours, first * neighbours + line)
        prefetch(rest.weights, first * neighbours + line)
    for values in posed:
        for line in range(0, values.shape[1] * WIDTH, WIDTH):
            prefetch_to_write(values, first * values.shape[1] + line)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _pose(fields, rest, bones, limits, posed):  # type: ignore[no-untyped-def]
    """Pose all Gaussians; array lengths are multiples of 16."""
    count = len(rest.neighbours)
    means, covariances, normals = posed.means, posed.covariances, posed.normals
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        joint_weights, rows = aligned_floats(len(bones) * WIDTH), aligned_floats(WIDTH * WIDTH)
        logits_16 = aligned_floats((fields.shape[1] - _LOGITS) * WIDTH)
        blend, offset = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        out = aligned_floats(WIDTH * WIDTH)
        for first in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, count), WIDTH):
            _prefetch_sixteen(first + WIDTH, rest, posed)
            _interpolate_sixteen(first, fields, rest, rows, out, posed.visibility, logits_16)
            transpose(out, offset)
            _blend_sixteen(first, rest, bones, rows, logits_16, joint_weights, blend)
            for c in range(6):
                store(offset, c * WIDTH, _tanh(load(offset, c * WIDTH)))
            _pose_sixteen(first, blend, offset, rest, limits, out)
            transpose(out, rows)
            for i in range(first, first + WIDTH):
                at = (i - first) * WIDTH
                for c in range(3):
                    means[i, c], normals[i, c] = rows[at + c], rows[at + 9 + c]
                for c in range(6):
                    covariances[i, c] = rows[at + 3 + c]
