"""The BRDF of trainer, runtime and tests: Lambert plus GGX, metallic 0.

    f = albedo/π + s · D·F·G / (4 n·l n·v)

with the share s = min(1, max(albedo)/F0): a surface that is darker than any dielectric is a cavity, or a black that
the camera's tone curve crushed (Karis 2013 fades F likewise). With the half vector h = (l + v)/|l + v| and α = γ² (γ
the perceptual roughness, clamped to [0.09, 0.99]),

    D = α² / (π (sin²θ_h + α² cos²θ_h)²)                              Walter et al. 2007, eq. 33
    G = G1(n·l) G1(n·v),  G1(μ) = 2μ / (μ + √(α² + (1 − α²)μ²))       Walter et al. 2007, eq. 23 and 34
    F = F0 + (1 − F0)(1 − v·h)⁵,  F0 = 0.04                            Schlick 1994

This is Disney's lobe (Burley 2012) without its remapping of α, as in Mitsuba. Smith's G is exact: the shortcut
k = (γ+1)²/8 loses 17–23 % of the energy. Height-correlated masking and shadowing (Heitz 2014, eq. 99) is 1.4 times G
at cosines of 0.2 and γ = 0.8 and makes rims too bright. Cosines are clamped to at least 1e-4 in G / (4 n·l n·v), which
is evaluated as one fraction without 0/0.

Directions l (to the light), v (to the camera) and n are unit vectors in one frame.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numba
import numpy as np

from rnd_runtime.core.simd.arithmetic import at_least, sqrt

F0 = 0.04
ROUGHNESS_RANGE = (0.09, 0.99)  # GGX's D overflows half floats below 0.089
COSINE_FLOOR = 1e-4
LARGEST_ALBEDO = 1 - F0 - (1 - F0) / 21
"""max albedo that conserves energy at any roughness; F averages to ∫ F(μ) 2μ dμ = F0 + (1 − F0)/21 over all views"""
_HALF_FLOOR = 1e-8  # min |l + v|², where light and camera are opposite


def specular(roughness: Any, n_dot_l: Any, n_dot_v: Any, l_dot_v: Any) -> Any:
    """D·F·G / (4 n·l n·v) in 1/sr from three cosines, for arrays that broadcast (numpy or torch)."""
    half_squared = (2 + 2 * l_dot_v).clip(min=_HALF_FLOOR)  # |l + v|²
    n_dot_h = n_dot_l + n_dot_v
    sine_squared = (1 - n_dot_h * n_dot_h / half_squared).clip(min=0)
    return ggx(roughness_to_alpha(roughness) ** 2, n_dot_l, n_dot_v, sine_squared, half_squared)


def roughness_to_alpha(roughness: Any) -> Any:
    """GGX's α = γ², γ clamped to its range."""
    return roughness.clip(*ROUGHNESS_RANGE) ** 2


def _ggx(sqrt: Callable[[Any], Any], at_least: Callable[[Any, Any], Any], number: Callable[[float], Any]) -> Any:
    """The specular term for values that ``sqrt``, ``at_least`` and constants of type ``number`` accept."""
    zero, half, one, f0, floor, one_over_pi = (number(x) for x in (0, 0.5, 1, F0, COSINE_FLOOR, 1 / pi))

    def ggx(alpha_squared, n_dot_l, n_dot_v, sine_squared, half_squared):  # type: ignore[no-untyped-def]
        """D·F·G / (4 n·l n·v) in 1/sr from α², two cosines, sin²θ_h and |l + v|²."""
        lobe = sine_squared + alpha_squared * (one - sine_squared)
        n_dot_l, n_dot_v = at_least(n_dot_l, floor), at_least(n_dot_v, floor)
        shadowing = n_dot_l + sqrt(alpha_squared + (one - alpha_squared) * n_dot_l * n_dot_l)
        masking = n_dot_v + sqrt(alpha_squared + (one - alpha_squared) * n_dot_v * n_dot_v)
        grazing = at_least(one - half * sqrt(half_squared), zero)  # 1 − v·h = 1 − |l + v|/2
        grazing_squared = grazing * grazing  # numpy's x**5 is slower than all the rest
        fresnel = f0 + (one - f0) * grazing_squared * grazing_squared * grazing
        return one_over_pi * alpha_squared * fresnel / (lobe * lobe * (shadowing * masking))

    return ggx


def _specular_share(at_least: Callable[[Any, Any], Any], number: Callable[[float], Any]) -> Any:
    """The share s for values that ``at_least`` and constants of type ``number`` accept."""
    zero, one, f0 = (number(x) for x in (0, 1, F0))

    def specular_share(red, green, blue):  # type: ignore[no-untyped-def]
        """The share s of the specular term."""
        return one - at_least(one - at_least(at_least(red, green), blue) / f0, zero)

    return specular_share


specular_share = _specular_share(lambda x, low: x.clip(min=low), float)  # numpy or torch
specular_share_scalar = numba.njit(_specular_share(max, np.float32), error_model="numpy")
specular_share_lanes = numba.njit(_specular_share(at_least, np.float32), error_model="numpy")
ggx = _ggx(lambda x: x**0.5, lambda x, low: x.clip(min=low), float)  # numpy or torch
ggx_scalar = numba.njit(_ggx(np.sqrt, max, np.float32), fastmath=True, error_model="numpy")
ggx_lanes = numba.njit(_ggx(sqrt, at_least, np.float32), error_model="numpy")
