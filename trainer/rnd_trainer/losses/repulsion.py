"""Repulsion of neighbouring Gaussians, which keeps them evenly spaced (after PU-Net, Yu et al. 2018, eq. 3)."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def repulsion(points: Tensor, reach: float) -> Tensor:
    """Σ (1 − d / reach)² / N over pairs of ``points`` [N, 3] m at distances d < ``reach`` m."""
    positions = points.detach().cpu().numpy()
    pairs = torch.from_numpy(cKDTree(positions).query_pairs(reach, output_type="ndarray")).to(points.device)
    first, second = pairs.unbind(dim=1)
    # clamped: the gradient of a norm is NaN at d = 0
    distance = (points[first] - points[second]).square().sum(-1).clamp(min=1e-12).sqrt()
    return (1 - distance / reach).square().sum() / max(len(points), 1)
