"""Poses all Gaussians of an avatar in one compiled pass (numba over sixteen lanes).

The networks' outputs at M nodes are interpolated for each of N Gaussians; then, with A blended skinning::

    fields = Σ_k weight_k · node fields[neighbour_k]          Δ logits, Δx and Δr before tanh, visibility
    W      = softmax(log W_template + Δ logits)
    A      = Σ_j W_j B_j = [A_R | A_T]                        see below
    t      = min(1, |cofactor(A_R) u| / |A_R u|²)             u: the limb's axis; 1 but where it is twisted
    κ      = share · (Newton–Schulz factor of t − 1)          widens what a twist has pinched
    mean   = A_R (x_c + max_offset · tanh Δx + κ lever) + A_T
    Σ      = F Fᵀ + floor² I,  F = A_R · C · R(tanh Δr) · (R S)   R(v): the quaternion normalize(1, v/2)
    normal = normalize((cofactor(A_R) + fallback · A_R) (n_c + κ u (u·n_c)))      C = (1 + κ) I − κ u uᵀ

``posing.reference`` computes the same in float64.

The template gives a Gaussian a few joints, and to all others its floor of 1e-6, which Δ logits may raise. A is summed
exactly over these few joints; the floor's part is summed over all joints at the nodes and interpolated as the fields
are. With the node's largest Δ logit c_k and c = Σ_k weight_k c_k::

    A ∝ Σ_{j of the template} (W_template,j / floor − 1) e^{Δ_j − c} B_j + Σ_k weight_k Σ_j e^{Δ_kj − c_k} B_j

The second sum takes the mean of the nodes' exponentials for the exponential of their mean: a trained avatar's Gaussians
move by 0.6 µm in the mean, at most by 0.2 mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rnd_runtime.core.sh import SH_COUNT
from rnd_runtime.core.simd import (
    WIDTH,
    aligned_floats,
    broadcast,
    exp2,
    lanes,
    load,
    prefetch,
    prefetch_to_write,
    select,
    sqrt,
    store,
    transpose,
)

Floats32 = NDArray[np.float32]

_CHUNK = 256  # Gaussians handed to a thread at a time
_LOG2_E = np.float32(np.log2(np.e))
_SMALLEST_POWER = np.float32(-126)  # of two in float32
_LARGEST_TANH = np.float32(9)  # beyond it tanh is 1 in float32
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
SHORTEST = np.float32(1e-9)  # of a normal before it is normalised
TWIST_STEPS = 3  # of Newton–Schulz, s → s (3 − s²)/2 on s = √t: two leave 0.54 of a limb at 150°, three 0.73
SMALLEST_SQUARE = np.float32(1e-6)  # of |A_R u|: a blend without length has no axis to be widened about
NEVER = np.float32(-1e30)  # log of no weight
# First components of a Gaussian's rest pose: points, factors, normals, limbs, floor; and how many there are
POINTS, FACTORS, NORMALS, LIMBS, FLOOR, OWN = (0, 3, 12, 15, 22, 23)
# A node's fields: Σ_j e^(Δ_j − c) B_j by rows, the same without B, and c; offsets, visibility, sixteen each; Δ_j
_SUM, _LARGEST, _OFFSETS, _VISIBILITY, _CHANGES = (12, 13, WIDTH, 2 * WIDTH, 3 * WIDTH)


class PosedArrays(NamedTuple):
    """Posed Gaussians in the frame of the bones; see ``core.gaussians.Gaussians``."""

    means: Floats32  # [N, 3] m
    covariances: Floats32  # [N, 6] m²
    normals: Floats32  # [N, 3] unit
    visibility: Floats32  # [N, 16]


@njit(inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """What is no number stays none: here and in ``_tanh`` comparisons fall to the bound only where they hold."""
    power = x * _LOG2_E
    return exp2(select(power < _SMALLEST_POWER, _SMALLEST_POWER, power))


@njit(inline="always")
def _tanh(x):  # type: ignore[no-untyped-def]
    """To 1e-7, absolute."""
    x = select(x > _LARGEST_TANH, _LARGEST_TANH, x)
    x = select(x < -_LARGEST_TANH, -_LARGEST_TANH, x)
    return lanes(_ONE) - lanes(_TWO) / (_exp(x * _TWO) + _ONE)


@njit(error_model="numpy", nogil=True, cache=True)
def pose_kernel(rest, nodes, bones, limits, count):  # type: ignore[no-untyped-def]
    """``PosedArrays`` of the ``count`` Gaussians of ``rest``; arguments as ``RestPose`` makes them."""
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
    """[J, 16]: of each joint B row by row, a one and zeros."""
    rows = np.zeros((len(bones), WIDTH), np.float32)
    for j in range(len(bones)):
        for k in range(_SUM):
            rows[j, k] = bones[j, k // 4, k % 4]
        rows[j, _SUM] = _ONE
    return rows


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def node_fields(logits, offsets, visibility, bones):  # type: ignore[no-untyped-def]
    """[M, 48 + J up to a multiple of 16]: of every node what is interpolated."""
    joints = len(bones)
    columns = _CHANGES + (joints + WIDTH - 1) // WIDTH * WIDTH
    fields = np.zeros((len(offsets), columns), np.float32)
    for m in prange(len(offsets)):
        largest = logits[m, 0]
        for j in range(joints):
            fields[m, _CHANGES + j] = logits[m, j]
            largest = max(largest, logits[m, j])
        blend = lanes(_ZERO)
        for j in range(joints):
            blend += _exp(lanes(logits[m, j] - largest)) * load(bones, j * WIDTH)
        store(fields, m * columns, blend)
        fields[m, _LARGEST] = largest
        for k in range(offsets.shape[1]):
            fields[m, _OFFSETS + k] = offsets[m, k]
        for k in range(visibility.shape[1]):
            fields[m, _VISIBILITY + k] = visibility[m, k]
    return fields


@njit(error_model="numpy")
def _interpolate_sixteen(first, fields, rest, blends, offsets, visibility, changes):  # type: ignore[no-untyped-def]
    """Fields of sixteen Gaussians a row each: sixteen columns of ``blends``, ``offsets`` and ``visibility`` (of which
    theirs is filled), and Δ logits less the nodes' largest in ``changes``."""
    width, changing = fields.shape[1], len(changes) // WIDTH
    for lane in range(WIDTH):
        i = first + lane
        blend, offset, seen = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
        for k in range(rest.neighbours.shape[1]):
            at, weight = rest.neighbours[i, k] * width, rest.weights[i, k]
            blend += weight * load(fields, at)
            offset += weight * load(fields, at + _OFFSETS)
            seen += weight * load(fields, at + _VISIBILITY)
        store(blends, lane * WIDTH, blend)
        store(offsets, lane * WIDTH, offset)
        store(visibility, i * WIDTH, seen)
        for column in range(0, changing, WIDTH):
            change = lanes(_ZERO) - broadcast(blends, lane * WIDTH + _LARGEST)
            for k in range(rest.neighbours.shape[1]):
                at = rest.neighbours[i, k] * width + _CHANGES + column
                change += rest.weights[i, k] * load(fields, at)
            store(changes, lane * changing + column, change)


@njit(error_model="numpy")
def _blend_sixteen(first, rest, bones, rows, changes, shares, blend):  # type: ignore[no-untyped-def]
    """A [3, 4] by component of sixteen Gaussians, from what is interpolated for them in ``rows`` and ``changes``.

    NaN where a logit is NaN or +∞, as a softmax is: the node's sums are. ``shares`` [slots, lanes] is working memory.
    """
    width = len(changes) // WIDTH
    start, end = WIDTH * rest.starts[first // WIDTH], WIDTH * rest.starts[first // WIDTH + 1]
    for at in range(start, end, WIDTH):
        for lane in range(WIDTH):
            shares[at - start + lane] = changes[lane * width + rest.joints[at + lane]]
        logs = load(rest.logs, at)
        weights = _exp(load(shares, at - start) + logs)
        store(shares, at - start, select(logs < _HALF * NEVER, _ZERO, weights))
    for lane in range(WIDTH):
        row = rest.own[first * OWN + FLOOR * WIDTH + lane] * load(rows, lane * WIDTH)
        for at in range(start + lane, end, WIDTH):
            row += shares[at - start] * load(bones, rest.joints[at] * WIDTH)
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
    """det(A) A⁻ᵀ, finite whatever A is."""
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
    """R(x, y, z) F with F row by row; R of the quaternion normalize(1, v/2)."""
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
    twist_left = sqrt(x * x + y * y + z * z) / length_squared
    twist_left = select(twist_left > _ONE, _ONE, twist_left)
    factor = lanes(_ONE)
    for _ in range(TWIST_STEPS):
        step = _HALF * (_THREE - twist_left)
        factor, twist_left = factor * step, twist_left * step * step
    return share * (factor - _ONE)


@njit
def _load3(array, first, i, stride):  # type: ignore[no-untyped-def]
    """Components ``first`` … ``first + 2`` of sixteen Gaussians, which begin at ``i`` and lie ``stride`` apart."""
    at = first * stride + i
    return load(array, at), load(array, at + stride), load(array, at + 2 * stride)


@njit
def _pose_sixteen(i, blend, offset, rest, limits, out):  # type: ignore[no-untyped-def]
    """Means, covariances and normals of Gaussians i … i + 15, twelve rows of sixteen in ``out``.

    ``blend`` has their A and ``offset`` their bounded offsets and turns, both by component.
    """
    max_offset, floor, fallback = limits
    at, stride = i * OWN, WIDTH
    first, second, third = (_load3(blend, 0, 0, WIDTH), _load3(blend, 4, 0, WIDTH), _load3(blend, 8, 0, WIDTH))
    a = first + second + third
    cofactors = _cofactors(a)
    axis, lever = _load3(rest.own, LIMBS, at, stride), _load3(rest.own, LIMBS + 3, at, stride)
    kappa = _widening(a, cofactors, axis, load(rest.own, (LIMBS + 6) * stride + at))

    point, moved = _load3(rest.own, POINTS, at, stride), _load3(offset, 0, 0, WIDTH)
    x = point[0] + max_offset * moved[0] + kappa * lever[0]
    y = point[1] + max_offset * moved[1] + kappa * lever[1]
    z = point[2] + max_offset * moved[2] + kappa * lever[2]
    x, y, z = _apply(a, x, y, z)
    store(out, 0, x + load(blend, 3 * WIDTH))
    store(out, WIDTH, y + load(blend, 7 * WIDTH))
    store(out, 2 * WIDTH, z + load(blend, 11 * WIDTH))

    f = (
        _load3(rest.own, FACTORS, at, stride)
        + _load3(rest.own, FACTORS + 3, at, stride)
        + _load3(rest.own, FACTORS + 6, at, stride)
    )
    rotation = _load3(offset, 3, 0, WIDTH)
    f = _rotated_rows(rotation[0], rotation[1], rotation[2], f)
    wide = _ONE + kappa
    x, y, z = _row(kappa * axis[0], kappa * axis[1], kappa * axis[2], f)
    f = (
        wide * f[0] - axis[0] * x,
        wide * f[1] - axis[0] * y,
        wide * f[2] - axis[0] * z,
        wide * f[3] - axis[1] * x,
        wide * f[4] - axis[1] * y,
        wide * f[5] - axis[1] * z,
        wide * f[6] - axis[2] * x,
        wide * f[7] - axis[2] * y,
        wide * f[8] - axis[2] * z,
    )
    f0, f1, f2 = _row(a[0], a[1], a[2], f)
    f3, f4, f5 = _row(a[3], a[4], a[5], f)
    f6, f7, f8 = _row(a[6], a[7], a[8], f)
    store(out, 3 * WIDTH, f0 * f0 + f1 * f1 + f2 * f2 + floor)
    store(out, 4 * WIDTH, f0 * f3 + f1 * f4 + f2 * f5)
    store(out, 5 * WIDTH, f0 * f6 + f1 * f7 + f2 * f8)
    store(out, 6 * WIDTH, f3 * f3 + f4 * f4 + f5 * f5 + floor)
    store(out, 7 * WIDTH, f3 * f6 + f4 * f7 + f5 * f8)
    store(out, 8 * WIDTH, f6 * f6 + f7 * f7 + f8 * f8 + floor)

    normal = _load3(rest.own, NORMALS, at, stride)
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
    """Has what a later sixteen reads and writes brought to the caches: a seventh of the time."""
    neighbours = rest.neighbours.shape[1]
    for line in range(0, OWN * WIDTH, WIDTH):
        prefetch(rest.own, first * OWN + line)
    for line in range(0, neighbours * WIDTH, WIDTH):
        prefetch(rest.neighbours, first * neighbours + line)
        prefetch(rest.weights, first * neighbours + line)
    for values in posed:
        for line in range(0, values.shape[1] * WIDTH, WIDTH):
            prefetch_to_write(values, first * values.shape[1] + line)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _pose(fields, rest, bones, limits, posed):  # type: ignore[no-untyped-def]
    """All Gaussians, whose arrays are as long as a multiple of registers."""
    count = len(rest.neighbours)
    means, covariances, normals = posed.means, posed.covariances, posed.normals
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        shares, rows = aligned_floats(len(bones) * WIDTH), aligned_floats(WIDTH * WIDTH)
        changes = aligned_floats((fields.shape[1] - _CHANGES) * WIDTH)
        blend, offset = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        out = aligned_floats(WIDTH * WIDTH)
        for first in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, count), WIDTH):
            _prefetch_sixteen(first + WIDTH, rest, posed)
            _interpolate_sixteen(first, fields, rest, rows, out, posed.visibility, changes)
            transpose(out, offset)
            _blend_sixteen(first, rest, bones, rows, changes, shares, blend)
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
