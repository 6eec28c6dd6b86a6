"""Edge-length term: stretch of the surface between bones in unseen poses."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from rnd_trainer.model.interpolate import NodeInterpolation
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.model.skinning import blend_transforms, transform_points

NEIGHBOURS = 6
"""edges per Gaussian"""
BETWEEN_BONES = 0.02
"""smallest Σ_j |ΔW_j| of the template along an edge; edges on a single bone do not stretch"""
MIN_LENGTH = 1e-3
"""lower bound of an edge's rest length, m"""


class EdgeLengths:
    """Edges between nearest Gaussians in the spread pose whose skinning weights differ.

    Args:
        model: its template and initial node interpolation.
    """

    def __init__(self, model: AvatarModel) -> None:
        codes = model.codes.cpu().numpy()
        pairs = _between_bones(codes, torch.softmax(model.log_weights, dim=-1).cpu().numpy())
        gaussians, ends = np.unique(pairs, return_inverse=True)
        neighbours = model.interpolate.neighbours.cpu().numpy()[gaussians]
        nodes, local = np.unique(neighbours, return_inverse=True)
        shares = model.interpolate.weights.cpu()[torch.as_tensor(gaussians)]
        device = model.points.device
        interpolate = NodeInterpolation(torch.as_tensor(local.reshape(neighbours.shape)), shares, len(nodes))
        self._interpolate = interpolate.to(device)
        self._first, self._second, self._gaussians, rows = (
            torch.as_tensor(x).to(device) for x in (*ends.reshape(-1, 2).T, gaussians, nodes)
        )
        self._encoded = model.encoded_nodes()[rows]
        self._log_template = model.log_weights[self._gaussians]

    def weights(self, model: AvatarModel, pose: PoseInput) -> Tensor:
        """Skinning weights [G, J] in ``pose`` of the edges' Gaussians."""
        logits = self._interpolate(model.skinning(self._encoded, pose.window, pose.velocity))
        return torch.softmax(self._log_template + logits, dim=-1)

    def stretch(self, weights: Tensor, points: Tensor, pose: PoseInput) -> Tensor:
        """Ratio [E] of each edge's length in ``pose`` to that at rest; no gradient by ``points`` [N, 3] m."""
        rest = points[self._gaussians].detach()
        posed = transform_points(blend_transforms(weights, pose.bones), rest)
        long, short = ((p[self._first] - p[self._second]).norm(dim=-1) for p in (posed, rest))
        return long / short.clamp(min=MIN_LENGTH)


def _between_bones(codes: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Unique edges [E, 2] of neighbours in ``codes`` [N, 3] m whose template weights [N, J] differ."""
    count = min(NEIGHBOURS + 1, len(codes))
    near = cKDTree(codes).query(codes, k=count)[1]
    pairs = np.stack([np.repeat(near[:, 0], count - 1), near[:, 1:].ravel()], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    differ = np.abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).sum(axis=1)
    return pairs[differ > BETWEEN_BONES]
