"""The one reflectance formula of trainer, runtime and tests: Lambert plus GGX, metallic 0.

    f = albedo/π + D·F·G / (4 n·l n·v)

with the half vector h = (l + v)/|l + v|, α = γ² (γ the perceptual roughness, clamped to [0.09, 0.99]) and

    D = α² / (π (sin²θ_h + α² cos²θ_h)²)                              Walter et al. 2007, eq. 33
    G = 1 / (1 + Λ(n·l) + Λ(n·v)),  Λ(μ) = (√(1 + α²(1/μ² − 1)) − 1)/2   Heitz 2014, eq. 72 and 99
    F = F0 + (1 − F0)(1 − v·h)⁵,  F0 = 0.04                            Schlick 1994

G is Smith's height-correlated one and is exact, not the k = (γ+1)²/8 shortcut, which loses 17–23 % of the
energy. G / (4 n·l n·v) is evaluated as ½ / (n·l √(α² + (1−α²)(n·v)²) + n·v √(α² + (1−α²)(n·l)²)), which is
the same number and has no 0/0. Cosines below 1e-4 count as 1e-4 in it: a Gaussian that faces slightly away
from the camera keeps the shading of its silhouette. Below the light's horizon the caller's max(n·l, 0) makes
all zero.

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
    masking = n_dot_l * (alpha_squared + (1 - alpha_squared) * n_dot_v * n_dot_v) ** 0.5
    shadowing = n_dot_v * (alpha_squared + (1 - alpha_squared) * n_dot_l * n_dot_l) ** 0.5
    grazing = (1 - 0.5 * half_squared**0.5).clip(min=0)  # 1 − v·h = 1 − |l + v|/2
    grazing_squared = grazing * grazing  # numpy's x**5 costs more than all the rest
    fresnel = F0 + (1 - F0) * grazing_squared * grazing_squared * grazing
    return (0.5 / pi) * alpha_squared * fresnel / (lobe * lobe * (masking + shadowing))


_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_F0, _COSINE_FLOOR, _HALF_OVER_PI = np.float32(F0), np.float32(COSINE_FLOOR), np.float32(0.5 / pi)


@numba.njit(inline="always", error_model="numpy")
def ggx32(alpha_squared, n_dot_l, n_dot_v, sine_squared, half_squared):  # type: ignore[no-untyped-def]
    """``ggx`` for float32 scalars inside kernels; Python's own constants would make float64 of it there."""
    lobe = sine_squared + alpha_squared * (_ONE - sine_squared)
    n_dot_l, n_dot_v = max(n_dot_l, _COSINE_FLOOR), max(n_dot_v, _COSINE_FLOOR)
    masking = n_dot_l * np.sqrt(alpha_squared + (_ONE - alpha_squared) * n_dot_v * n_dot_v)
    shadowing = n_dot_v * np.sqrt(alpha_squared + (_ONE - alpha_squared) * n_dot_l * n_dot_l)
    grazing = max(_ONE - _HALF * np.sqrt(half_squared), _ZERO)
    grazing_squared = grazing * grazing
    fresnel = _F0 + (_ONE - _F0) * grazing_squared * grazing_squared * grazing
    return _HALF_OVER_PI * alpha_squared * fresnel / (lobe * lobe * (masking + shadowing))
