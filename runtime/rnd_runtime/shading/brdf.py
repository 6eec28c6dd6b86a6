"""The one reflectance formula of trainer, runtime and tests: Lambert plus GGX, metallic 0.

    f = albedo/π + D·F·G / (4 n·l n·v)

with the half vector h = (l + v)/|l + v|, α = γ² (γ the perceptual roughness, clamped to [0.09, 0.99]) and

    D = α² / (π (sin²θ_h + α² cos²θ_h)²)                              Walter et al. 2007, eq. 33
    G = G1(n·l) G1(n·v),  G1(μ) = 2μ / (μ + √(α² + (1 − α²)μ²))       Walter et al. 2007, eq. 23 and 34
    F = F0 + (1 − F0)(1 − v·h)⁵,  F0 = 0.04                            Schlick 1994

That is Disney's lobe (Burley 2012, which the paper names) without its remapping of α, and what Mitsuba and the data
rendered by it have. Smith's G is exact, not the k = (γ+1)²/8 shortcut, which loses 17–23 % of the energy. With masking
and shadowing correlated by height (Heitz 2014, eq. 99) G is larger where light and view both graze, 1.4 times at
cosines of 0.2 and γ = 0.8: a sun behind the person then draws too bright a rim. G / (4 n·l n·v) is evaluated as one
fraction, which has no 0/0. Cosines below 1e-4 count as 1e-4 in it: a Gaussian that faces slightly away from the camera
keeps the shading of its silhouette. Below the light's horizon the caller's max(n·l, 0) makes all zero.

Directions l (to the light), v (to the camera) and n are unit vectors in one frame.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numba
import numpy as np

F0 = 0.04
ROUGHNESS_RANGE = (0.09, 0.99)  # GGX's D overflows half floats below 0.089
COSINE_FLOOR = 1e-4
LARGEST_ALBEDO = 1 - F0 - (1 - F0) / 21
"""of what gives back no more than it gets, whatever its roughness: a smooth surface's gloss gives back the mean of F
over all views, ∫ F(μ) 2μ dμ = F0 + (1 − F0)/21, and a rough one's less"""
_HALF_FLOOR = 1e-8  # |l + v|² where light and camera are opposite and h does not exist


def brdf(albedo: Any, roughness: Any, n_dot_l: Any, n_dot_v: Any, l_dot_v: Any) -> Any:
    """f in 1/sr, without the cosine, for arrays that broadcast (numpy or torch alike)."""
    return albedo * (1 / pi) + specular(roughness, n_dot_l, n_dot_v, l_dot_v)


def specular(roughness: Any, n_dot_l: Any, n_dot_v: Any, l_dot_v: Any) -> Any:
    """D·F·G / (4 n·l n·v) in 1/sr from three cosines, for arrays that broadcast (numpy or torch alike)."""
    half_squared = (2 + 2 * l_dot_v).clip(min=_HALF_FLOOR)  # |l + v|²
    n_dot_h = n_dot_l + n_dot_v
    sine_squared = (1 - n_dot_h * n_dot_h / half_squared).clip(min=0)
    return ggx(roughness_to_alpha(roughness), n_dot_l, n_dot_v, sine_squared, half_squared)


def roughness_to_alpha(roughness: Any) -> Any:
    """GGX's α = γ² with γ clamped to its range."""
    return roughness.clip(*ROUGHNESS_RANGE) ** 2


def ggx(alpha: Any, n_dot_l: Any, n_dot_v: Any, sine_squared: Any, half_squared: Any) -> Any:
    """The specular term from sin²θ_h and |l + v|², for callers that know them better than cosines tell."""
    alpha_squared = alpha * alpha
    lobe = sine_squared + alpha_squared * (1 - sine_squared)
    n_dot_l, n_dot_v = n_dot_l.clip(min=COSINE_FLOOR), n_dot_v.clip(min=COSINE_FLOOR)
    shadowing = n_dot_l + (alpha_squared + (1 - alpha_squared) * n_dot_l * n_dot_l) ** 0.5
    masking = n_dot_v + (alpha_squared + (1 - alpha_squared) * n_dot_v * n_dot_v) ** 0.5
    grazing = (1 - 0.5 * half_squared**0.5).clip(min=0)  # 1 − v·h = 1 − |l + v|/2
    grazing_squared = grazing * grazing  # numpy's x**5 costs more than all the rest
    fresnel = F0 + (1 - F0) * grazing_squared * grazing_squared * grazing
    return (1 / pi) * alpha_squared * fresnel / (lobe * lobe * (shadowing * masking))


_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_F0, _COSINE_FLOOR, _ONE_OVER_PI = np.float32(F0), np.float32(COSINE_FLOOR), np.float32(1 / pi)


@numba.njit(inline="always", error_model="numpy")
def ggx32(alpha_squared, n_dot_l, n_dot_v, sine_squared, half_squared):  # type: ignore[no-untyped-def]
    """``ggx`` for float32 scalars inside kernels; Python's own constants would make float64 of it there."""
    lobe = sine_squared + alpha_squared * (_ONE - sine_squared)
    n_dot_l, n_dot_v = max(n_dot_l, _COSINE_FLOOR), max(n_dot_v, _COSINE_FLOOR)
    shadowing = n_dot_l + np.sqrt(alpha_squared + (_ONE - alpha_squared) * n_dot_l * n_dot_l)
    masking = n_dot_v + np.sqrt(alpha_squared + (_ONE - alpha_squared) * n_dot_v * n_dot_v)
    grazing = max(_ONE - _HALF * np.sqrt(half_squared), _ZERO)
    grazing_squared = grazing * grazing
    fresnel = _F0 + (_ONE - _F0) * grazing_squared * grazing_squared * grazing
    return _ONE_OVER_PI * alpha_squared * fresnel / (lobe * lobe * (shadowing * masking))
