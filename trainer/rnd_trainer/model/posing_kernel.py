"""Compiled posing of all Gaussians in one pass, forward and backward; see ``model.skinning``."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from .matrix_kernels import (
    FAST,
    apply,
    cross,
    inline,
    load,
    multiply,
    quaternion,
    rotation_backward,
    rotation_matrix,
    scale_columns,
    transpose,
)
from .skinning import NORMAL_FALLBACK, THICKNESS_FLOOR
from .twist import SMALLEST_SQUARE, STEPS


class PoseGaussians(torch.autograd.Function):
    """Means [N, 3], covariances [N, 6] and unit normals [N, 3] of posed Gaussians.

    Arguments as ``model.posing.pose_gaussians``, with the axes, levers and shares of ``TwistFrames`` last.
    Not differentiable w.r.t. tangents, axes, levers and shares.
    """

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ctx.arrays = tuple(np.ascontiguousarray(t.detach().numpy(), np.float32) for t in tensors)
        return tuple(torch.from_numpy(a) for a in _pose(*ctx.arrays))  # type: ignore[return-value]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Tensor | None, ...]:
        grads = _pose_backward(*ctx.arrays, *(np.ascontiguousarray(g.numpy()) for g in incoming))
        weights, blend, points, delta_rotation, rotation, scales, normals = (torch.from_numpy(g) for g in grads)
        bones = None
        if ctx.needs_input_grad[1]:
            bones = (torch.from_numpy(ctx.arrays[0]).T @ blend).view(ctx.arrays[1].shape)
        return weights, bones, points, delta_rotation, None, rotation, scales, normals, None, None, None


@inline
def _normal_matrix(m):
    """cofactor(M) + ε M."""
    a, b, c = (m[0], m[1], m[2]), (m[3], m[4], m[5]), (m[6], m[7], m[8])
    first, second, third = cross(b, c), cross(c, a), cross(a, b)
    e = np.float32(NORMAL_FALLBACK)
    return (
        first[0] + e * m[0],
        first[1] + e * m[1],
        first[2] + e * m[2],
        second[0] + e * m[3],
        second[1] + e * m[4],
        second[2] + e * m[5],
        third[0] + e * m[6],
        third[1] + e * m[7],
        third[2] + e * m[8],
    )


@inline
def _normal_matrix_backward(m, g):
    """Gradient w.r.t. M, from the gradient g by ``_normal_matrix(M)``."""
    a, b, c = (m[0], m[1], m[2]), (m[3], m[4], m[5]), (m[6], m[7], m[8])
    first, second, third = (g[0], g[1], g[2]), (g[3], g[4], g[5]), (g[6], g[7], g[8])
    a1, a2 = cross(second, c), cross(b, third)
    b1, b2 = cross(c, first), cross(third, a)
    c1, c2 = cross(first, b), cross(a, second)
    e = np.float32(NORMAL_FALLBACK)
    return (
        a1[0] + a2[0] + e * g[0],
        a1[1] + a2[1] + e * g[1],
        a1[2] + a2[2] + e * g[2],
        b1[0] + b2[0] + e * g[3],
        b1[1] + b2[1] + e * g[4],
        b1[2] + b2[2] + e * g[5],
        c1[0] + c2[0] + e * g[6],
        c1[1] + c2[1] + e * g[7],
        c1[2] + c2[2] + e * g[8],
    )


@inline
def _blend(weights, bones, n):
    """A = Σ_j W_j B_j: the 3×3 part and the translation."""
    zero = np.float32(0)
    a = (zero, zero, zero, zero, zero, zero, zero, zero, zero)
    x = y = z = zero
    for j in range(weights.shape[1]):
        w, b = weights[n, j], bones[j]
        a = (
            a[0] + w * b[0, 0],
            a[1] + w * b[0, 1],
            a[2] + w * b[0, 2],
            a[3] + w * b[1, 0],
            a[4] + w * b[1, 1],
            a[5] + w * b[1, 2],
            a[6] + w * b[2, 0],
            a[7] + w * b[2, 1],
            a[8] + w * b[2, 2],
        )
        x, y, z = x + w * b[0, 3], y + w * b[1, 3], z + w * b[2, 3]
    return a, (x, y, z)


@inline
def _excess(linear, axes, shares, n):
    """``model.twist.excess``."""
    x, y, z = axes[n, 0], axes[n, 1], axes[n, 2]
    a, b, c = apply(linear, x, y, z)
    length_squared = max(a * a + b * b + c * c, np.float32(SMALLEST_SQUARE))
    first, second, third = (linear[0], linear[1], linear[2]), (linear[3], linear[4], linear[5]), linear[6:]
    p, q, r = cross(second, third), cross(third, first), cross(first, second)
    a, b, c = p[0] * x + p[1] * y + p[2] * z, q[0] * x + q[1] * y + q[2] * z, r[0] * x + r[1] * y + r[2] * z
    ratio = min(np.sqrt(a * a + b * b + c * c) / length_squared, np.float32(1))
    factor = np.float32(1)
    for _ in range(STEPS):
        step = np.float32(0.5) * (np.float32(3) - ratio)
        factor, ratio = factor * step, ratio * step * step
    return shares[n] * (factor - np.float32(1))


@inline
def _widen(m, axes, kappa, n):
    """C M with C = (1 + κ) I − κ u uᵀ."""
    x, y, z = axes[n, 0], axes[n, 1], axes[n, 2]
    k = np.float32(1) + kappa
    a = kappa * (x * m[0] + y * m[3] + z * m[6])
    b = kappa * (x * m[1] + y * m[4] + z * m[7])
    c = kappa * (x * m[2] + y * m[5] + z * m[8])
    return (
        k * m[0] - x * a,
        k * m[1] - x * b,
        k * m[2] - x * c,
        k * m[3] - y * a,
        k * m[4] - y * b,
        k * m[5] - y * c,
        k * m[6] - z * a,
        k * m[7] - z * b,
        k * m[8] - z * c,
    )


@inline
def _widen_normal(x, y, z, axes, kappa, n):
    """n + κ u (u·n)."""
    along = kappa * (axes[n, 0] * x + axes[n, 1] * y + axes[n, 2] * z)
    return (x + axes[n, 0] * along, y + axes[n, 1] * along, z + axes[n, 2] * along)


@numba.njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")
def _pose(weights, bones, points, delta_rotation, tangents, rotation, scales, normals, axes, levers, shares):
    count = len(points)
    means = np.empty((count, 3), np.float32)
    covariances = np.empty((count, 6), np.float32)
    posed_normals = np.empty((count, 3), np.float32)
    floor = np.float32(THICKNESS_FLOOR**2)
    for n in numba.prange(count):
        linear, shift = _blend(weights, bones, n)
        kappa = _excess(linear, axes, shares, n)
        x, y, z = apply(
            linear,
            points[n, 0] + kappa * levers[n, 0],
            points[n, 1] + kappa * levers[n, 1],
            points[n, 2] + kappa * levers[n, 2],
        )
        means[n, 0], means[n, 1], means[n, 2] = x + shift[0], y + shift[1], z + shift[2]

        own, _ = quaternion(rotation[n, 0], rotation[n, 1], rotation[n, 2])
        added, _ = quaternion(delta_rotation[n, 0], delta_rotation[n, 1], delta_rotation[n, 2])
        frame = scale_columns(multiply(load(tangents, n), rotation_matrix(own)), scales, n)
        g = multiply(linear, _widen(multiply(rotation_matrix(added), frame), axes, kappa, n))
        covariances[n, 0] = g[0] * g[0] + g[1] * g[1] + g[2] * g[2] + floor
        covariances[n, 1] = g[0] * g[3] + g[1] * g[4] + g[2] * g[5]
        covariances[n, 2] = g[0] * g[6] + g[1] * g[7] + g[2] * g[8]
        covariances[n, 3] = g[3] * g[3] + g[4] * g[4] + g[5] * g[5] + floor
        covariances[n, 4] = g[3] * g[6] + g[4] * g[7] + g[5] * g[8]
        covariances[n, 5] = g[6] * g[6] + g[7] * g[7] + g[8] * g[8] + floor

        x, y, z = _widen_normal(normals[n, 0], normals[n, 1], normals[n, 2], axes, kappa, n)
        x, y, z = apply(_normal_matrix(linear), x, y, z)
        length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-9))
        posed_normals[n, 0], posed_normals[n, 1], posed_normals[n, 2] = x / length, y / length, z / length
    return means, covariances, posed_normals


@numba.njit(parallel=True, cache=True, fastmath=FAST, error_model="numpy")
def _pose_backward(
    weights,
    bones,
    points,
    delta_rotation,
    tangents,
    rotation,
    scales,
    normals,
    axes,
    levers,
    shares,
    by_mean,
    by_covariance,
    by_normal,
):
    count, joints = weights.shape
    by_weights, by_blend = np.empty((count, joints), np.float32), np.empty((count, 12), np.float32)
    by_points, by_delta_rotation = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    by_rotation, by_scales = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    by_rest_normals = np.empty((count, 3), np.float32)
    two = np.float32(2)
    for n in numba.prange(count):
        linear, _ = _blend(weights, bones, n)
        transposed = transpose(linear)
        mx, my, mz = by_mean[n, 0], by_mean[n, 1], by_mean[n, 2]
        kappa = _excess(linear, axes, shares, n)
        px, py, pz = (
            points[n, 0] + kappa * levers[n, 0],
            points[n, 1] + kappa * levers[n, 1],
            points[n, 2] + kappa * levers[n, 2],
        )
        by_points[n, 0], by_points[n, 1], by_points[n, 2] = apply(transposed, mx, my, mz)

        own, own_length = quaternion(rotation[n, 0], rotation[n, 1], rotation[n, 2])
        added, added_length = quaternion(delta_rotation[n, 0], delta_rotation[n, 1], delta_rotation[n, 2])
        added_matrix = rotation_matrix(added)
        frame = multiply(load(tangents, n), rotation_matrix(own))
        scaled = scale_columns(frame, scales, n)
        rotated = _widen(multiply(added_matrix, scaled), axes, kappa, n)
        g = multiply(linear, rotated)
        c = by_covariance[n]
        symmetric = (
            two * c[0],
            c[1],
            c[2],
            c[1],
            two * c[3],
            c[4],
            c[2],
            c[4],
            two * c[5],
        )  # twice the gradient by the symmetric matrix
        by_g = multiply(symmetric, g)
        by_linear = multiply(by_g, transpose(rotated))
        by_rotated = _widen(multiply(transposed, by_g), axes, kappa, n)
        by_added = multiply(by_rotated, transpose(scaled))
        u = rotation_backward(added, added_length, by_added)
        by_delta_rotation[n, 0], by_delta_rotation[n, 1], by_delta_rotation[n, 2] = u
        by_scaled = multiply(transpose(added_matrix), by_rotated)
        by_scales[n, 0] = frame[0] * by_scaled[0] + frame[3] * by_scaled[3] + frame[6] * by_scaled[6]
        by_scales[n, 1] = frame[1] * by_scaled[1] + frame[4] * by_scaled[4] + frame[7] * by_scaled[7]
        by_scales[n, 2] = frame[2] * by_scaled[2] + frame[5] * by_scaled[5] + frame[8] * by_scaled[8]
        by_frame = scale_columns(by_scaled, scales, n)
        by_own = multiply(transpose(load(tangents, n)), by_frame)
        r = rotation_backward(own, own_length, by_own)
        by_rotation[n, 0], by_rotation[n, 1], by_rotation[n, 2] = r

        matrix = _normal_matrix(linear)
        nx, ny, nz = _widen_normal(normals[n, 0], normals[n, 1], normals[n, 2], axes, kappa, n)
        x, y, z = apply(matrix, nx, ny, nz)
        length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-9))
        x, y, z = x / length, y / length, z / length
        gx, gy, gz = by_normal[n, 0], by_normal[n, 1], by_normal[n, 2]
        along = x * gx + y * gy + z * gz
        gx, gy, gz = (gx - x * along) / length, (gy - y * along) / length, (gz - z * along) / length
        x, y, z = apply(transpose(matrix), gx, gy, gz)
        x, y, z = _widen_normal(x, y, z, axes, kappa, n)
        by_rest_normals[n, 0], by_rest_normals[n, 1], by_rest_normals[n, 2] = x, y, z
        outer = (gx * nx, gx * ny, gx * nz, gy * nx, gy * ny, gy * nz, gz * nx, gz * ny, gz * nz)
        k = _normal_matrix_backward(linear, outer)

        a = (
            by_linear[0] + k[0] + mx * px,
            by_linear[1] + k[1] + mx * py,
            by_linear[2] + k[2] + mx * pz,
            by_linear[3] + k[3] + my * px,
            by_linear[4] + k[4] + my * py,
            by_linear[5] + k[5] + my * pz,
            by_linear[6] + k[6] + mz * px,
            by_linear[7] + k[7] + mz * py,
            by_linear[8] + k[8] + mz * pz,
        )
        for row in range(3):
            for column in range(3):
                by_blend[n, 4 * row + column] = a[3 * row + column]
        by_blend[n, 3], by_blend[n, 7], by_blend[n, 11] = mx, my, mz
        for j in range(joints):
            b = bones[j]
            by_weights[n, j] = (
                a[0] * b[0, 0]
                + a[1] * b[0, 1]
                + a[2] * b[0, 2]
                + mx * b[0, 3]
                + a[3] * b[1, 0]
                + a[4] * b[1, 1]
                + a[5] * b[1, 2]
                + my * b[1, 3]
                + a[6] * b[2, 0]
                + a[7] * b[2, 1]
                + a[8] * b[2, 2]
                + mz * b[2, 3]
            )
    return by_weights, by_blend, by_points, by_delta_rotation, by_rotation, by_scales, by_rest_normals
