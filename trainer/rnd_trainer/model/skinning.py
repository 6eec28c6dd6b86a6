"""Blend skinning of points, normals and covariances."""

from __future__ import annotations

import torch
from torch import Tensor

NORMAL_FALLBACK = 1e-3
"""share of A_R n in a posed normal, for a vanishing cofactor matrix (a 180° twist)"""
THICKNESS_FLOOR = 1e-4
"""smallest standard deviation of a posed Gaussian, m"""


def blend_transforms(weights: Tensor, bones: Tensor) -> Tensor:
    """A = Σ_j W_j B_j: weights [N, J], bones [J, 3, 4] → [N, 3, 4]."""
    return (weights @ bones.flatten(1)).unflatten(1, (3, 4))


def transform_points(blend: Tensor, points: Tensor) -> Tensor:
    """A_R x + A_T: [N, 3, 4], [N, 3] → [N, 3]."""
    return (blend[:, :, :3] * points[:, None, :]).sum(-1) + blend[:, :, 3]


def cofactor(matrices: Tensor) -> Tensor:
    """Cofactor matrices of [N, 3, 3]: det(M)·M⁻ᵀ, finite whatever M is. Rows are cross products of M's rows."""
    a, b, c = matrices.unbind(1)
    return torch.stack([torch.cross(b, c, dim=-1), torch.cross(c, a, dim=-1), torch.cross(a, b, dim=-1)], dim=1)


def transform_normals(blend: Tensor, normals: Tensor) -> Tensor:
    """Posed unit normals [N, 3]: the inverse transpose of A_R up to scale, since A_R need not be a rotation."""
    linear = blend[:, :, :3]
    mixed = cofactor(linear) + NORMAL_FALLBACK * linear
    return torch.nn.functional.normalize((mixed * normals[:, None, :]).sum(-1), dim=-1, eps=1e-9)


def covariances(factors: Tensor) -> Tensor:
    """Upper triangles [N, 6] (xx, xy, xz, yy, yz, zz) of F Fᵀ + floor² I for factors F [N, 3, 3]: positive definite."""
    x, y, z = factors.unbind(1)
    floor = THICKNESS_FLOOR**2
    return torch.stack(
        [
            (x * x).sum(-1) + floor,
            (x * y).sum(-1),
            (x * z).sum(-1),
            (y * y).sum(-1) + floor,
            (y * z).sum(-1),
            (z * z).sum(-1) + floor,
        ],
        dim=-1,
    )


def small_rotation(w: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of the quaternions normalize(1, w/2), w [N, 3]: axis-angle to second order."""
    q = torch.nn.functional.normalize(torch.cat([torch.ones_like(w[:, :1]), 0.5 * w], dim=-1), dim=-1)
    s, x, y, z = q.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - s * z),
        2 * (x * z + s * y),
        2 * (x * y + s * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - s * x),
        2 * (x * z - s * y),
        2 * (y * z + s * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def tangent_frames(normals: Tensor) -> Tensor:
    """Rotations [N, 3, 3] whose columns are two tangents and the unit normal (Duff et al. 2017)."""
    x, y, z = normals.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    second = torch.stack([b, sign + y * y * a, -y], dim=-1)
    return torch.stack([first, second, normals], dim=-1)
