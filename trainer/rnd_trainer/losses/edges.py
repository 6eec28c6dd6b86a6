"""Neighbours on the skin stay neighbours, in poses that nobody filmed: the edge-length term.

A short video shows few poses, and what no picture shows nothing holds: where a template's weights change from one
bone to the next within a spacing, a squat tears the skin apart. Pictures cannot mend it. Lengths can: they are known
in every pose there is.
"""

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
"""edges that leave a Gaussian"""
BETWEEN_BONES = 0.02
"""Σ_j |ΔW_j| of the template from which an edge counts: what hangs on one bone cannot be stretched"""
LEAST_LENGTH = 1e-3
"""metres that an edge has at least: two Gaussians may lie on one another"""


class EdgeLengths:
    """The edges that hang on more than one bone, and how far a pose stretches them.

    Edges join Gaussians to their nearest in the spread pose; stretch is their length in the pose over that at rest.
    Only skinning weights feel it: points are taken as given.

    Args:
        model: of which the template is read once; ``weights`` evaluates its network as it is then.
    """

    def __init__(self, model: AvatarModel) -> None:
        codes = model.codes.cpu().numpy()
        pairs = _between_bones(codes, torch.softmax(model.log_weights, dim=-1).cpu().numpy())
        gaussians, ends = np.unique(pairs, return_inverse=True)
        known = model.interpolate.neighbours.cpu().numpy()[gaussians]
        nodes, local = np.unique(known, return_inverse=True)
        shares = model.interpolate.weights.cpu()[torch.as_tensor(gaussians)]
        device = model.points.device
        self._interpolate = NodeInterpolation(torch.as_tensor(local.reshape(known.shape)), shares, len(nodes)).to(
            device
        )
        self._first, self._second, self._gaussians, rows = (
            torch.as_tensor(x).to(device) for x in (*ends.reshape(-1, 2).T, gaussians, nodes)
        )
        self._encoded = model.encoded_nodes()[rows]
        self._log_template = model.log_weights[self._gaussians]

    def weights(self, model: AvatarModel, pose: PoseInput) -> Tensor:
        """Skinning weights [G, J] in ``pose`` of the Gaussians that such edges join."""
        logits = self._interpolate(model.skinning(self._encoded, pose.window, pose.velocity))
        return torch.softmax(self._log_template + logits, dim=-1)

    def stretch(self, weights: Tensor, points: Tensor, pose: PoseInput) -> Tensor:
        """Of every edge [E] by those ``weights`` in ``pose``, with ``points`` [N, 3] m of the rest pose."""
        rest = points[self._gaussians].detach()
        posed = transform_points(blend_transforms(weights, pose.bones), rest)
        long, short = ((p[self._first] - p[self._second]).norm(dim=-1) for p in (posed, rest))
        return long / short.clamp(min=LEAST_LENGTH)


def _between_bones(codes: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Edges [E, 2] of neighbours in ``codes`` [N, 3] whose template weights [N, J] differ, each once."""
    count = min(NEIGHBOURS + 1, len(codes))
    near = cKDTree(codes).query(codes, k=count)[1]
    pairs = np.stack([np.repeat(near[:, 0], count - 1), near[:, 1:].ravel()], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    differ = np.abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).sum(axis=1)
    return pairs[differ > BETWEEN_BONES]
