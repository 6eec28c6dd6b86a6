"""Poses fitted to images by render-and-compare: the avatar is frozen, only the corrections of a pose move."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from rnd_trainer.config import TrainConfig
from rnd_trainer.losses.losses import image_loss, linear_to_srgb
from rnd_trainer.model.model import AvatarModel, PosedGaussians, PoseInput
from rnd_trainer.render.probe import sample_texels
from rnd_trainer.render.render import shade_visible, splat
from rnd_trainer.training.data import TrainingView

from .refinement import PoseRefinement

SCALE = 0.5
"""of the training images, for the images compared"""


@dataclass(frozen=True)
class Search:
    """Steps of Adam for one frame; the rate falls linearly to zero where it ``cools``; the root may keep its place."""

    steps: int
    rate: float
    cools: bool = False
    root_moves: bool = True


@dataclass(frozen=True, eq=False)
class Compared:
    """An image, and the light there.

    Attributes:
        light: radiance, directions and solid angles of the texels; None: the avatar has plain colours.
    """

    view: TrainingView
    light: tuple[Tensor, Tensor, Tensor] | None


@contextmanager
def frozen(model: nn.Module) -> Iterator[None]:
    """``model`` without gradients of its parameters."""
    learned = [p for p in model.parameters() if p.requires_grad]
    for parameter in learned:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)


@contextmanager
def unless_raised(refinement: PoseRefinement) -> Iterator[None]:
    """Keep the corrections of all frames as they are if an exception leaves the block."""
    before = [raw.detach().clone() for raw in refinement.raw]
    try:
        yield
    except BaseException:
        for raw, old in zip(refinement.raw, before):
            raw.data.copy_(old)
        raise


def fit_pose(
    model: AvatarModel,
    config: TrainConfig,
    refinement: PoseRefinement,
    pose: PoseInput,
    images: Sequence[Compared],
    search: Search,
    generator: torch.Generator,
) -> None:
    """Move the correction of the frame of ``images`` until the frozen avatar looks like them.

    Args:
        pose: of that frame, uncorrected.
        generator: of the light's sampled texels.
    """
    frame = images[0].view.frame.frame
    raw = refinement.raw[refinement.row[frame]]
    fields = model.fields(pose)
    optimizer = torch.optim.Adam([raw], lr=search.rate, betas=(0.9, 0.99))
    for step in range(search.steps):
        if search.cools:
            optimizer.param_groups[0]["lr"] = search.rate * (1 - step / search.steps)
        optimizer.zero_grad()
        moved = replace(pose, bones=refinement.bones(frame))
        posed = model.placed(fields, moved.bones)
        losses = [_difference(model, config, posed, moved, image, generator) for image in images]
        (config.weight_poses * refinement.prior(frame) + torch.stack(losses).sum()).backward()
        if not search.root_moves and raw.grad is not None:
            raw.grad[-1] = 0
        optimizer.step()
    raw.grad = None


def _difference(
    model: AvatarModel,
    config: TrainConfig,
    posed: PosedGaussians,
    pose: PoseInput,
    image: Compared,
    generator: torch.Generator,
) -> Tensor:
    """Loss of one image on black: as in training, without the terms of the model alone."""
    view, device = image.view, posed.means.device
    radiance = posed.attributes.colour
    if image.light is not None:
        texels = sample_texels(*image.light, config.light_texels, generator)
        radiance = shade_visible(posed, pose, texels, view.camera, model, config.traced_texels)
    rendered = splat(posed, radiance, view.camera)
    target, mask = (x.to(device) for x in view.target(torch.zeros(3)))
    loss = image_loss(linear_to_srgb(rendered.image), linear_to_srgb(target), config.weight_dssim, config.dssim_scales)
    return loss + config.weight_mask * (rendered.alpha - mask).abs().mean()
