"""Posing of all Gaussians: the plain torch version, and the compiled one where it can serve."""

from __future__ import annotations

import torch
from torch import Tensor

from .posing_kernel import PoseGaussians
from .skinning import blend_transforms, covariances, small_rotation, transform_normals, transform_points


def pose_gaussians(
    weights: Tensor,  # [N, J]
    bones: Tensor,  # [J, 3, 4]
    points: Tensor,  # [N, 3] m, rest pose, all offsets added
    turn: Tensor,  # [N, 3] Δr, a rotation vector
    tangents: Tensor,  # [N, 3, 3] tangent frames of the rest pose
    rotation: Tensor,  # [N, 3] r_c in the tangent frame, a rotation vector
    scales: Tensor,  # [N, 3] m
    normals: Tensor,  # [N, 3] unit, rest pose
) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3] m, covariances [N, 6] m² and unit normals [N, 3] in the world frame.

    Σ' = F Fᵀ with F = A_R · R(Δr) · R_c · S. Float32 on the CPU takes the compiled kernel, which has no gradient
    by bones and tangents.
    """
    if not weights.is_cuda and weights.dtype == torch.float32:
        return PoseGaussians.apply(weights, bones, points, turn, tangents, rotation, scales, normals)
    blend = blend_transforms(weights, bones)
    frames = small_rotation(turn) @ tangents @ small_rotation(rotation)
    factors = blend[:, :, :3] @ (frames * scales[:, None, :])
    return transform_points(blend, points), covariances(factors), transform_normals(blend, normals)
