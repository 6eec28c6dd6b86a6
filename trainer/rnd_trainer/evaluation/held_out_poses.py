"""Poses of held-out frames, fitted by render-and-compare with the avatar frozen: how real video is scored."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.motion.motion import Motion
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.render.probe import LightProbes
from rnd_trainer.training.data import TrainingView, load_views, pose_input
from rnd_trainer.training.poses.refinement import PoseRefinement
from rnd_trainer.training.poses.render_and_compare import SCALE, Compared, Search, fit_pose, frozen
from rnd_trainer.training.poses.uncertainty import load_uncertainty

STEPS = 40
"""of every frame"""
RATE = 6e-3


def fit_held_out(
    checkpoint: Checkpoint,
    capture: Capture,
    splits: Iterable[Split] = ("novel_pose",),
    *,
    steps: int = STEPS,
    scale: float = SCALE,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> Motion:
    """The capture's motion with the poses of its held-out frames corrected within ``PoseRefinement``'s bounds.

    Only poses move: shape, appearance and light stay the avatar's. As the frames' own images are used, their scores
    then tell of appearance and shape, not of poses.

    Args:
        steps: of the optimizer, each frame.
        scale: of the images compared.
        on_frame: called with frames done and in all.
    """
    motion, skeleton, config = capture.motion, capture.body.skeleton, checkpoint.config
    views = [view for split in splits if capture.split(split) for view in load_views(capture, split, scale)[0]]
    frames = sorted({view.frame.frame for view in views})
    if not frames:
        return motion
    unsure = load_uncertainty(capture.folder, motion.frame_count, len(skeleton))
    refinement = PoseRefinement(motion, skeleton, frames, unsure)
    generator = torch.Generator().manual_seed(config.seed)
    maps, lit = LightProbes(), config.light != "none"

    def compared(view: TrainingView) -> Compared:
        light = (checkpoint.probe_of(view.frame.light), maps.directions, maps.solid_angles) if lit else None
        return Compared(view, light)

    with frozen(checkpoint.model):
        for done, frame in enumerate(frames):
            images = [compared(view) for view in views if view.frame.frame == frame]
            pose = pose_input(motion, skeleton, frame / motion.fps, config.model)
            fit_pose(checkpoint.model, config, refinement, pose, images, Search(steps, RATE), generator)
            on_frame(done + 1, len(frames))
    return refinement.apply_to(motion)
