"""The third stage, without images: the skinning network learns unseen poses.

In a training pose, or a perturbed one, points stay where the network after the second stage puts them
(self-distillation). In a random pose edges keep their lengths, and weights change smoothly with the pose.
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

from .sampled_poses import jittered_pose, sampled_pose

MM2 = 1e6
"""mm² of a square metre"""
NODE_STRIDE = 3
"""every third node is looked at in a filmed pose, by turns: all of them would take half of a step"""


class UnseenPoses:
    """The terms of the third stage.

    Args:
        model: as the pictures have left it. Its skinning network is copied, and the rest taken as fixed.
        skeleton: whose joints are turned in sampled poses.
        config: weights, and the seed that with the step gives what is sampled.

    Attributes:
        teacher: the skinning network after the second stage.
    """

    def __init__(self, model: AvatarModel, skeleton: Skeleton, config: TrainConfig) -> None:
        self._skeleton, self._config = skeleton, config
        self._edges = EdgeLengths(model)
        self.teacher: DynamicSkinning = copy.deepcopy(model.skinning).requires_grad_(False)
        with torch.no_grad():
            encoded = model.encoded_nodes()
            self._points = model.attributes(encoded).points
        nodes = len(encoded)
        self._nodes = encoded, model.log_weights[:nodes], self._points[:nodes]

    def __call__(self, model: AvatarModel, pose: PoseInput, step: int) -> dict[str, Tensor]:
        """Weighted terms by name: distillation in ``pose``; stretch and smoothness in the random pose of ``step``."""
        rng = np.random.default_rng((self._config.seed, step))
        sampled = sampled_pose(self._skeleton, self._config.model, rng).to(self._points.device)
        weights, near = (self._edges.weights(model, p) for p in (sampled, jittered_pose(sampled, rng)))
        stretch = self._edges.stretch(weights, self._points, sampled)
        return {
            "distillation": MM2 * self._moved(model, pose, step % NODE_STRIDE).square().sum(-1).mean(),
            "edges": self._config.weight_edges * stretch_penalty(stretch),
            "smoothness": self._config.weight_smooth * (weights - near).square().sum(-1).mean(),
        }

    def _moved(self, model: AvatarModel, pose: PoseInput, first: int) -> Tensor:
        """How far every third node from ``first`` on is [M / 3, 3] m from where the teacher puts it."""
        encoded, log_template, points = (values[first::NODE_STRIDE] for values in self._nodes)
        placed = []
        for network in (model.skinning, self.teacher):
            weights = torch.softmax(log_template + network(encoded, pose.window, pose.velocity), dim=-1)
            placed.append(transform_points(blend_transforms(weights, pose.bones), points))
        return placed[0] - placed[1]
