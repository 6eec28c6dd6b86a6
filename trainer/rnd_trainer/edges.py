"""Neighbours on the skin stay neighbours, in poses that nobody filmed: the edge-length term.

A short video shows few poses, and what no picture shows nothing holds: where a template's weights change from one
bone to the next within a spacing, a squat tears the skin apart. Pictures cannot mend it. Lengths can: they are known
in every pose there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from rnd_runtime.motion import Motion
from rnd_runtime.rotations import axis_angle_to_matrix
from rnd_runtime.skeleton import Skeleton

from .config import ModelConfig
from .data import pose_input
from .interpolate import NodeInterpolation
from .model import AvatarModel, PoseInput
from .skinning import blend_transforms, transform_points
from .template import along_curve

NEIGHBOURS = 6
"""edges that leave a Gaussian"""
BETWEEN_BONES = 0.02
"""Σ_j |ΔW_j| of the template from which an edge counts: what hangs on one bone cannot be stretched"""
PARTS = 8
"""of the skin: each step looks at the edges of one"""
LEAST_LENGTH = 1e-3
"""metres that an edge has at least: two Gaussians may lie on one another"""
TURNED_JOINTS = 5
"""joints that a drawn pose turns"""
WIDEST_TURN = 2.2
"""radians that it turns them at most, about any axis: a knee's and a hip's reach"""
FASTEST_SHARE = 0.5
"""of its turns that a pose may have made within the window"""


@dataclass
class DrawnSkin:
    """Skin in a drawn pose: stretch [E] of its edges, weights [G, J] of their ends and log_template [G, J] of those."""

    stretch: Tensor
    weights: Tensor
    log_template: Tensor


class EdgeLengths:
    """The edges that hang on more than one bone, and how far drawn poses stretch them: an eighth of them a step.

    Edges join Gaussians to their nearest in the spread pose; stretch is their length in the drawn pose over that at
    rest. Only skinning weights feel it: points are taken as given.

    Args:
        model: of which the template is read once; every call evaluates its weights as they are then.
        skeleton: whose joints are turned.
        seed: of the poses; with the step it gives the pose, so that a resumed run draws the same ones.
    """

    def __init__(self, model: AvatarModel, skeleton: Skeleton, seed: int) -> None:
        self._skeleton, self._seed, self._config = skeleton, seed, model.config
        codes = model.codes.cpu().numpy()
        pairs = _between_bones(codes, torch.softmax(model.log_weights, dim=-1).cpu().numpy())
        pairs = pairs[along_curve(codes[pairs[:, 0]])]
        self._parts = [_part(model, part) for part in np.array_split(pairs, PARTS)]

    def __call__(self, model: AvatarModel, points: Tensor, step: int) -> DrawnSkin:
        """A part of the skin with ``points`` [N, 3] m of the rest pose, in a pose that ``step`` gives."""
        rng = np.random.default_rng((self._seed, step))
        pose = drawn_pose(self._skeleton, self._config, rng).to(points.device)
        return _drawn(model, points, pose, self._parts[step % PARTS])

    def stretch(self, model: AvatarModel, points: Tensor, pose: PoseInput) -> Tensor:
        """Of all edges [E] in ``pose``."""
        return torch.cat([_drawn(model, points, pose, part).stretch for part in self._parts])


@dataclass
class _Part:
    """Edges of a part of the body: their ends [E] among its Gaussians [G], and the nodes that these read, encoded."""

    first: Tensor
    second: Tensor
    gaussians: Tensor
    log_template: Tensor
    encoded: Tensor
    interpolate: NodeInterpolation


def _part(model: AvatarModel, pairs: NDArray[np.int64]) -> _Part:
    gaussians, ends = np.unique(pairs, return_inverse=True)
    known = model.interpolate.neighbours.cpu().numpy()[gaussians]
    nodes, local = np.unique(known, return_inverse=True)
    shares = model.interpolate.weights.cpu()[torch.as_tensor(gaussians)]
    interpolate = NodeInterpolation(torch.as_tensor(local.reshape(known.shape)), shares, len(nodes))
    device = model.points.device
    first, second, rows, node_rows = (
        torch.as_tensor(x).to(device) for x in (*ends.reshape(-1, 2).T, gaussians, nodes)
    )
    encoded = model.encoded_nodes()[node_rows]
    return _Part(first, second, rows, model.log_weights[rows], encoded, interpolate.to(device))


def _drawn(model: AvatarModel, points: Tensor, pose: PoseInput, part: _Part) -> DrawnSkin:
    logits = part.interpolate(model.skinning(part.encoded, pose.window, pose.velocity))
    weights = torch.softmax(part.log_template + logits, dim=-1)
    rest = points[part.gaussians].detach()
    posed = transform_points(blend_transforms(weights, pose.bones), rest)
    long, short = ((p[part.first] - p[part.second]).norm(dim=-1) for p in (posed, rest))
    return DrawnSkin(long / short.clamp(min=LEAST_LENGTH), weights, part.log_template)


def drawn_pose(skeleton: Skeleton, config: ModelConfig, rng: np.random.Generator) -> PoseInput:
    """A few joints turned far about any axis, and a window in which they come there from up to half-way."""
    joints = len(skeleton)
    turned = 1 + rng.permutation(joints - 1)[:TURNED_JOINTS]
    axes = rng.standard_normal((len(turned), 3))
    angles = np.zeros((joints, 3))
    angles[turned] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angles[turned] *= rng.uniform(0, WIDEST_TURN, (len(turned), 1))
    frames = max(config.window_poses, 2)
    reached = np.linspace(1 - rng.uniform(0, FASTEST_SHARE), 1, frames)
    fps = (frames - 1) / config.window_seconds
    motion = Motion(
        axis_angle_to_matrix(reached[:, None, None] * angles), np.zeros((frames, 3)), fps, skeleton.names
    )
    return pose_input(motion, skeleton, (frames - 1) / fps, config)


def _between_bones(codes: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Edges [E, 2] of neighbours in ``codes`` [N, 3] whose template weights [N, J] differ, each once."""
    count = min(NEIGHBOURS + 1, len(codes))
    near = cKDTree(codes).query(codes, k=count)[1]
    pairs = np.stack([np.repeat(near[:, 0], count - 1), near[:, 1:].ravel()], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    differ = np.abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).sum(axis=1)
    return pairs[differ > BETWEEN_BONES]
