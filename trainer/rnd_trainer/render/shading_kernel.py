"""Compiled shading in one pass over (Gaussian, texel) pairs, forward and backward.

Formulas of ``rnd_runtime.shading.brdf``; equal to ``render.shading.shade`` to float32 rounding.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from rnd_runtime.shading.brdf import COSINE_FLOOR, F0, ROUGHNESS_RANGE, specular_share

CHUNKS = 16
"""blocks of Gaussians with separate sums over texels: deterministic for any number of threads"""
_FAST = {"reassoc", "contract", "arcp", "nsz"}  # not nnan, ninf: a NaN must stay one


class FusedShade(torch.autograd.Function):
    """Outgoing radiance [n, 3]; arguments as ``render.shading.shade``.

    Differentiable in normals, albedo, roughness and power; view, visibility and directions are constants.
    """

    @staticmethod
    def forward(
        ctx: Any,
        normals: Tensor,  # [n, 3]
        view: Tensor,  # [n, 3]
        albedo: Tensor,  # [n, 3]
        roughness: Tensor,  # [n]
        visibility: Tensor,  # [n, K]
        directions: Tensor,  # [K, 3]
        power: Tensor,  # [K, 3]
    ) -> Tensor:
        tensors = (normals, view, albedo, roughness, visibility, directions, power)
        n, v, ctx.albedo, gamma, visible, towards, strength = (
            np.ascontiguousarray(t.detach().numpy(), np.float32) for t in tensors
        )
        half_squared = np.maximum(2 + 2 * (v @ towards.T), np.float32(1e-8))  # zero where light and camera are opposite
        ctx.inputs = (n, v, gamma, visible, towards.T.copy(), strength.T.copy(), half_squared)
        ctx.diffuse, ctx.specular = _sum(*ctx.inputs)
        ctx.share = specular_share(*ctx.albedo.T)[:, None]
        radiance = ctx.albedo * ctx.diffuse * np.float32(1 / np.pi) + ctx.share * ctx.specular
        ctx.lit = radiance > 0
        return torch.from_numpy(np.maximum(radiance, 0))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        incoming = np.ascontiguousarray(grad.numpy() * ctx.lit)
        grad_normals, grad_roughness, grad_power = _sum_backward(*ctx.inputs, ctx.albedo, ctx.share[:, 0], incoming)
        grad_albedo = incoming * ctx.diffuse * np.float32(1 / np.pi)
        largest = np.arange(len(incoming)), ctx.albedo.argmax(1)
        grad_share = (incoming * ctx.specular).sum(1) * np.float32(1 / F0)
        grad_albedo[largest] += np.where(ctx.share[:, 0] < 1, grad_share, np.float32(0))
        results = (grad_normals, None, grad_albedo, grad_roughness, None, None, grad_power)
        return tuple(None if r is None else torch.from_numpy(r) for r in results)


@numba.njit(inline="always", error_model="numpy")
def _specular(alpha_squared, n_dot_l, n_dot_v, half_squared):
    """Specular term, and the derivatives of its logarithm by α², n·l and n·v."""
    one, two, zero, floor = np.float32(1), np.float32(2), np.float32(0), np.float32(COSINE_FLOOR)
    n_dot_h = n_dot_l + n_dot_v
    sine_squared = max(one - n_dot_h * n_dot_h / half_squared, zero)
    lobe = sine_squared + alpha_squared * (one - sine_squared)
    light, view = max(n_dot_l, floor), max(n_dot_v, floor)
    rest = one - alpha_squared
    sqrt_view = np.sqrt(alpha_squared + rest * view * view)
    sqrt_light = np.sqrt(alpha_squared + rest * light * light)
    shadowing, masking = light + sqrt_light, view + sqrt_view
    grazing = max(one - np.float32(0.5) * np.sqrt(half_squared), zero)
    fresnel = np.float32(F0) + np.float32(1 - F0) * grazing * grazing * grazing * grazing * grazing
    value = np.float32(1 / np.pi) * alpha_squared * fresnel / (lobe * lobe * (shadowing * masking))

    by_sine = -two * rest / lobe
    sine_by_cosine = -two * n_dot_h / half_squared if sine_squared > zero else zero
    by_alpha = (
        one / alpha_squared
        - two * (one - sine_squared) / lobe
        - np.float32(0.5) * (one - light * light) / (sqrt_light * shadowing)
        - np.float32(0.5) * (one - view * view) / (sqrt_view * masking)
    )
    by_light = by_sine * sine_by_cosine
    by_view = by_light
    if n_dot_l > floor:
        by_light -= (one + rest * light / sqrt_light) / shadowing
    if n_dot_v > floor:
        by_view -= (one + rest * view / sqrt_view) / masking
    return value, by_alpha, by_light, by_view


@numba.njit(inline="always")
def _alpha_squared(roughness):
    low, high = np.float32(ROUGHNESS_RANGE[0]), np.float32(ROUGHNESS_RANGE[1])
    alpha = min(max(roughness, low), high) ** 2
    return alpha * alpha


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _sum(normals, view, roughness, visibility, directions, power, half_squared):
    """Σ_k v (n·l) power and Σ_k v (n·l) specular power, each [n, 3].

    directions and power come as [3, K]; half_squared [n, K] is |l + v|².
    """
    count, texels = visibility.shape
    zero = np.float32(0)
    diffuse, specular = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    for i in numba.prange(count):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        n_dot_v = nx * view[i, 0] + ny * view[i, 1] + nz * view[i, 2]
        alpha_squared = _alpha_squared(roughness[i])
        d0 = d1 = d2 = s0 = s1 = s2 = zero
        for k in range(texels):
            n_dot_l = nx * directions[0, k] + ny * directions[1, k] + nz * directions[2, k]
            visible_cosine = visibility[i, k] * max(n_dot_l, zero)
            value, _, _, _ = _specular(alpha_squared, n_dot_l, n_dot_v, half_squared[i, k])
            d0 += visible_cosine * power[0, k]
            d1 += visible_cosine * power[1, k]
            d2 += visible_cosine * power[2, k]
            s0 += visible_cosine * value * power[0, k]
            s1 += visible_cosine * value * power[1, k]
            s2 += visible_cosine * value * power[2, k]
        diffuse[i, 0], diffuse[i, 1], diffuse[i, 2] = d0, d1, d2
        specular[i, 0], specular[i, 1], specular[i, 2] = s0, s1, s2
    return diffuse, specular


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _sum_backward(normals, view, roughness, visibility, directions, power, half_squared, albedo, share, grad):
    """Gradients by normals [n, 3], roughness [n] and power [K, 3], given that of the radiance."""
    count, texels = visibility.shape
    zero, over_pi = np.float32(0), np.float32(1 / np.pi)
    low, high = np.float32(ROUGHNESS_RANGE[0]), np.float32(ROUGHNESS_RANGE[1])
    by_normal, by_roughness = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    by_power = np.zeros((CHUNKS, 3, texels), np.float32)
    for chunk in numba.prange(CHUNKS):
        partial = by_power[chunk]
        for i in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
            n_dot_v = nx * view[i, 0] + ny * view[i, 1] + nz * view[i, 2]
            alpha_squared = _alpha_squared(roughness[i])
            g0, g1, g2 = grad[i, 0], grad[i, 1], grad[i, 2]
            a0, a1, a2 = g0 * albedo[i, 0] * over_pi, g1 * albedo[i, 1] * over_pi, g2 * albedo[i, 2] * over_pi
            g0, g1, g2 = g0 * share[i], g1 * share[i], g2 * share[i]
            gx = gy = gz = by_view_sum = by_alpha_sum = zero
            for k in range(texels):
                lx, ly, lz = directions[0, k], directions[1, k], directions[2, k]
                n_dot_l = nx * lx + ny * ly + nz * lz
                cosine = max(n_dot_l, zero)
                visible_cosine = visibility[i, k] * cosine
                value, by_alpha, by_light, by_view = _specular(alpha_squared, n_dot_l, n_dot_v, half_squared[i, k])
                p0, p1, p2 = power[0, k], power[1, k], power[2, k]
                specular = g0 * p0 + g1 * p1 + g2 * p2
                diffuse = a0 * p0 + a1 * p1 + a2 * p2
                by_value = visible_cosine * specular * value
                by_alpha_sum += by_value * by_alpha
                by_view_sum += by_value * by_view
                facing = visibility[i, k] if n_dot_l > zero else zero
                by_cosine = by_value * by_light + facing * (diffuse + specular * value)
                gx += by_cosine * lx
                gy += by_cosine * ly
                gz += by_cosine * lz
                partial[0, k] += visible_cosine * (a0 + g0 * value)
                partial[1, k] += visible_cosine * (a1 + g1 * value)
                partial[2, k] += visible_cosine * (a2 + g2 * value)
            by_normal[i, 0] = gx + by_view_sum * view[i, 0]
            by_normal[i, 1] = gy + by_view_sum * view[i, 1]
            by_normal[i, 2] = gz + by_view_sum * view[i, 2]
            gamma = roughness[i]
            inside = low < gamma < high
            by_roughness[i] = np.float32(4) * gamma * gamma * gamma * by_alpha_sum if inside else zero
    sum_power = np.zeros((texels, 3), np.float32)
    for chunk in range(CHUNKS):
        sum_power += by_power[chunk].T
    return by_normal, by_roughness, sum_power
