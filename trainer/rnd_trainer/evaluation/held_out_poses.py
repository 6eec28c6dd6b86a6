"""Poses of held-out frames, fitted by render-and-compare with the avatar frozen: how real video is scored."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import torch
from torch import Tensor

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.motion.motion import Motion
from rnd_trainer.losses.losses import image_loss, linear_to_srgb
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.model.model import PosedGaussians, PoseInput
from rnd_trainer.render.probe import LightProbes, Texels, sample_texels
from rnd_trainer.render.render import Splat, shade_visible, splat
from rnd_trainer.training.data import TrainingView, load_views, pose_input
from rnd_trainer.training.poses.refinement import PoseRefinement
from rnd_trainer.training.poses.uncertainty import load_uncertainty

STEPS = 40
"""of every frame"""
RATE = 6e-3
SCALE = 0.5
"""of the images compared"""


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
    frozen = [p for p in checkpoint.model.parameters() if p.requires_grad]
    for parameter in frozen:
        parameter.requires_grad_(False)
    generator = torch.Generator().manual_seed(config.seed)
    for done, frame in enumerate(frames):
        here = [view for view in views if view.frame.frame == frame]
        pose = pose_input(motion, skeleton, frame / motion.fps, config.model)
        optimizer = torch.optim.Adam([refinement.raw[refinement.row[frame]]], lr=RATE, betas=(0.9, 0.99))
        fields = checkpoint.model.fields(pose)
        for _ in range(steps):
            optimizer.zero_grad()
            moved = replace(pose, bones=refinement.bones(frame))
            posed = checkpoint.model.placed(fields, moved.bones)
            losses = [_difference(checkpoint, view, posed, moved, generator) for view in here]
            (config.weight_poses * refinement.prior(frame) + torch.stack(losses).sum()).backward()
            optimizer.step()
        on_frame(done + 1, len(frames))
    for parameter in frozen:
        parameter.requires_grad_(True)
    return refinement.apply_to(motion)


def _difference(
    checkpoint: Checkpoint, view: TrainingView, posed: PosedGaussians, pose: PoseInput, generator: torch.Generator
) -> Tensor:
    """Loss of one image on black: as in training, without the terms of the model alone."""
    config = checkpoint.config
    texels = None
    if config.light != "none":
        maps, probe = LightProbes(), checkpoint.probe_of(view.frame.light)
        texels = sample_texels(probe, maps.directions, maps.solid_angles, config.light_texels, generator)
    rendered = _rendered(checkpoint, view, posed, pose, texels)
    target, mask = view.target(torch.zeros(3))
    image = image_loss(linear_to_srgb(rendered.image), linear_to_srgb(target), config.weight_dssim, config.dssim_scales)
    return image + config.weight_mask * (rendered.alpha - mask).abs().mean()


def _rendered(
    checkpoint: Checkpoint, view: TrainingView, posed: PosedGaussians, pose: PoseInput, texels: Texels | None
) -> Splat:
    if texels is None:
        return splat(posed, posed.attributes.colour, view.camera)
    traced = checkpoint.config.traced_texels
    return splat(posed, shade_visible(posed, pose, texels, view.camera, checkpoint.model, traced), view.camera)
