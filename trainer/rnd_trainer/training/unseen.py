"""Third stage, without images: skinning in unseen poses.

Self-distillation in training poses and perturbed ones; edge lengths and smooth skinning weights in random poses.
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
"""distillation evaluates every third node, in rotation; all of them would take half of a step"""


class UnseenPoses:
    """The terms of the third stage.

    Args:
        model: after the second stage; all but its skinning network is taken as fixed.
        skeleton: of the sampled poses.
        config: weights, and the seed of the sampled poses.

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
        """Weighted terms by name: distillation in ``pose``, edges and smoothness in the random pose of ``step``."""
        rng = np.random.default_rng((self._config.seed, step))
        sampled = sampled_pose(self._skeleton, self._config.model, rng).to(self._points.device)
        weights, jittered = (self._edges.weights(model, p) for p in (sampled, jittered_pose(sampled, rng)))
        stretch = self._edges.stretch(weights, self._points, sampled)
        return {
            "distillation": MM2 * self._distillation_offsets(model, pose, step % NODE_STRIDE).square().sum(-1).mean(),
            "edges": self._config.weight_edges * stretch_penalty(stretch),
            "smoothness": self._config.weight_smooth * (weights - jittered).square().sum(-1).mean(),
        }

    def _distillation_offsets(self, model: AvatarModel, pose: PoseInput, first: int) -> Tensor:
        """Offsets [M / 3, 3] m of every third node, from ``first`` on, from its position by the teacher."""
        encoded, log_template, points = (values[first::NODE_STRIDE] for values in self._nodes)
        positions = []
        for network in (model.skinning, self.teacher):
            weights = torch.softmax(log_template + network(encoded, pose.window, pose.velocity), dim=-1)
            positions.append(transform_points(blend_transforms(weights, pose.bones), points))
        return positions[0] - positions[1]
