"""The last steps, without pictures: the skinning network learns poses that nobody filmed.

Every step holds two things. In a filmed pose, or in one near it, skin stays where the pictures have put it: the network
as it was after the last of them is the teacher (self-distillation). In a drawn pose, far from all that was filmed,
edges keep their lengths, and weights hardly change where the pose hardly does.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.motion.skeleton import Skeleton
from rnd_trainer.config import TrainConfig
from rnd_trainer.losses.edges import EdgeLengths
from rnd_trainer.losses.losses import stretch_penalty
from rnd_trainer.model.encoders import DynamicSkinning
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.model.skinning import blend_transforms, transform_points

from .sampled_poses import drawn_pose, nudged_pose

MM2 = 1e6
"""mm² of a square metre"""
KEPT_NODES = 3
"""every third node is looked at in a filmed pose, by turns: all of them would take half of a step"""


class UnseenPoses:
    """The terms of the third stage.

    Args:
        model: as the pictures have left it. Its skinning network is copied, and the rest taken as fixed.
        skeleton: whose joints are turned in drawn poses.
        config: weights, and the seed that with the step gives what is drawn.

    Attributes:
        taught: the skinning network as the pictures have left it.
    """

    def __init__(self, model: AvatarModel, skeleton: Skeleton, config: TrainConfig) -> None:
        self._skeleton, self._config = skeleton, config
        self._edges = EdgeLengths(model)
        self.taught: DynamicSkinning = copy.deepcopy(model.skinning).requires_grad_(False)
        with torch.no_grad():
            encoded = model.encoded_nodes()
            self._points = model.attributes(encoded).points
        nodes = len(encoded)
        self._nodes = encoded, model.log_weights[:nodes], self._points[:nodes]

    def __call__(self, model: AvatarModel, pose: PoseInput, step: int) -> dict[str, Tensor]:
        """Weighted terms by name: skin kept in ``pose``; in one that ``step`` gives edges' stretch, weights' calm."""
        rng = np.random.default_rng((self._config.seed, step))
        drawn = drawn_pose(self._skeleton, self._config.model, rng).to(self._points.device)
        weights, near = (self._edges.weights(model, p) for p in (drawn, nudged_pose(drawn, rng)))
        stretch = self._edges.stretch(weights, self._points, drawn)
        return {
            "kept": MM2 * self._moved(model, pose, step % KEPT_NODES).square().sum(-1).mean(),
            "edges": self._config.weight_edges * stretch_penalty(stretch),
            "smooth": self._config.weight_smooth * (weights - near).square().sum(-1).mean(),
        }

    def _moved(self, model: AvatarModel, pose: PoseInput, first: int) -> Tensor:
        """How far every third node from ``first`` on is [M / 3, 3] m from where it was taught to be."""
        encoded, log_template, points = (values[first::KEPT_NODES] for values in self._nodes)
        placed = []
        for network in (model.skinning, self.taught):
            weights = torch.softmax(log_template + network(encoded, pose.window, pose.velocity), dim=-1)
            placed.append(transform_points(blend_transforms(weights, pose.bones), points))
        return placed[0] - placed[1]
