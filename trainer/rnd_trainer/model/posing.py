"""Posing of all Gaussians, in torch or by the compiled kernel."""

from __future__ import annotations

import torch
from torch import Tensor

from .posing_kernel import PoseGaussians
from .skinning import blend_transforms, cofactor, covariances, small_rotation, transform_normals, transform_points
from .twist import TwistFrames, excess


def pose_gaussians(
    weights: Tensor,  # [N, J]
    bones: Tensor,  # [J, 3, 4]
    points: Tensor,  # [N, 3] m, rest pose, all offsets added
    delta_rotation: Tensor,  # [N, 3] Δr, a rotation vector
    tangents: Tensor,  # [N, 3, 3] tangent frames of the rest pose
    rotation: Tensor,  # [N, 3] r_c in the tangent frame, a rotation vector
    scales: Tensor,  # [N, 3] m
    normals: Tensor,  # [N, 3] unit, rest pose
    limbs: TwistFrames,
) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3] m, covariances [N, 6] m² and unit normals [N, 3] in the world frame.

    Σ' = F Fᵀ with F = A_R · C · R(Δr) · R_c · S and C the widening of ``model.twist``. Float32 on the CPU uses the
    compiled kernel, without gradient by ``tangents``.
    """
    if not weights.is_cuda and weights.dtype == torch.float32:
        twist = (limbs.axes, limbs.levers, limbs.shares)
        return PoseGaussians.apply(weights, bones, points, delta_rotation, tangents, rotation, scales, normals, *twist)
    blend = blend_transforms(weights, bones)
    linear, axes = blend[:, :, :3], limbs.axes
    kappa = excess(linear, cofactor(linear), limbs)[:, None]
    points = points + kappa * limbs.levers
    normals = normals + kappa * axes * (axes * normals).sum(-1, keepdim=True)
    factors = (small_rotation(delta_rotation) @ tangents @ small_rotation(rotation)) * scales[:, None, :]
    along = axes[:, :, None] * (axes[:, :, None] * factors).sum(1, keepdim=True)
    factors = factors + kappa[..., None] * (factors - along)
    return transform_points(blend, points), covariances(linear @ factors), transform_normals(blend, normals)
