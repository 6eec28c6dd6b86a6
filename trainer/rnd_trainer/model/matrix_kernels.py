"""3×3 matrices for kernels, as row-major tuples of nine scalars, which stay in registers; quaternions (w, x, y, z)."""

from __future__ import annotations

import numba
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz"}  # not nnan, ninf: a NaN must stay one
inline = numba.njit(fastmath=FAST, error_model="numpy")  # inlined by LLVM; numba's inlining fails on tuples


@inline
def row(x, y, z, b):
    """(x, y, z) B."""
    return (x * b[0] + y * b[3] + z * b[6], x * b[1] + y * b[4] + z * b[7], x * b[2] + y * b[5] + z * b[8])


@inline
def multiply(a, b):
    """A B."""
    p, q, r = row(a[0], a[1], a[2], b), row(a[3], a[4], a[5], b), row(a[6], a[7], a[8], b)
    return (p[0], p[1], p[2], q[0], q[1], q[2], r[0], r[1], r[2])


@inline
def transpose(a):
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@inline
def apply(a, x, y, z):
    """A (x, y, z)."""
    return (a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z)


@inline
def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inline
def quaternion(x, y, z):
    """normalize(1, v/2) and its length before normalisation."""
    half = np.float32(0.5)
    x, y, z = half * x, half * y, half * z
    length = np.sqrt(np.float32(1) + x * x + y * y + z * z)
    return (np.float32(1) / length, x / length, y / length, z / length), length


@inline
def rotation_matrix(q):
    s, x, y, z = q
    one, two = np.float32(1), np.float32(2)
    return (
        one - two * (y * y + z * z),
        two * (x * y - s * z),
        two * (x * z + s * y),
        two * (x * y + s * z),
        one - two * (x * x + z * z),
        two * (y * z - s * x),
        two * (x * z - s * y),
        two * (y * z + s * x),
        one - two * (x * x + y * y),
    )


@inline
def rotation_backward(q, length, h):
    """Gradient w.r.t. the rotation vector, from the gradient h by the matrix of ``rotation_matrix(quaternion(v))``."""
    s, x, y, z = q
    two = np.float32(2)
    by_s = two * (-z * h[1] + y * h[2] + z * h[3] - x * h[5] - y * h[6] + x * h[7])
    by_x = two * (y * (h[1] + h[3]) + z * (h[2] + h[6]) - two * x * (h[4] + h[8]) + s * (h[7] - h[5]))
    by_y = two * (x * (h[1] + h[3]) + z * (h[5] + h[7]) - two * y * (h[0] + h[8]) + s * (h[2] - h[6]))
    by_z = two * (x * (h[2] + h[6]) + y * (h[5] + h[7]) - two * z * (h[0] + h[4]) + s * (h[3] - h[1]))
    along = s * by_s + x * by_x + y * by_y + z * by_z
    factor = np.float32(0.5) / length
    return (factor * (by_x - x * along), factor * (by_y - y * along), factor * (by_z - z * along))


@inline
def load(matrices, n):
    m = matrices[n]
    return (m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@inline
def scale_columns(m, scales, n):
    """M diag(s)."""
    s, t, u = scales[n, 0], scales[n, 1], scales[n, 2]
    return (m[0] * s, m[1] * t, m[2] * u, m[3] * s, m[4] * t, m[5] * u, m[6] * s, m[7] * t, m[8] * u)
