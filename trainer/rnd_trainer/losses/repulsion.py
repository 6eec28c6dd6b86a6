"""Gaussians keep apart on the skin: the repulsion term.

Nothing in a picture holds two Gaussians apart that strayed onto one another. In another pose they leave a gap: what
lies between them and their neighbours is all that the skin there can stretch. Point clouds are kept even with such a
term since PU-Net (Yu et al. 2018, eq. 3), whose weights fall with distance; here a pair costs nothing from a least
distance on.
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def repulsion(points: Tensor, least: float) -> Tensor:
    """Σ (1 − d / least)² over pairs of ``points`` [N, 3] m nearer to one another than ``least`` metres, over N."""
    known = points.detach().cpu().numpy()
    pairs = torch.from_numpy(cKDTree(known).query_pairs(least, output_type="ndarray")).to(points.device)
    first, second = pairs.unbind(dim=1)
    # two Gaussians on one point have no direction to part in: a norm's gradient would be NaN there, this one's is 0
    distance = (points[first] - points[second]).square().sum(-1).clamp(min=1e-12).sqrt()
    return (1 - distance / least).square().sum() / max(len(points), 1)
