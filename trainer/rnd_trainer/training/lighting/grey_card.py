"""A neutral card in a training image: it fixes the colour and the level that light and albedo share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.shading.light import texel_directions, texel_solid_angles
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.in_sight import in_sight
from rnd_trainer.render.probe import PROBE_SHAPE
from rnd_trainer.render.shading import traced_visibility
from rnd_trainer.training.data import TrainingView

OPTION = "--grey-card"
CARD_REFLECTANCE = 0.18
"""of a photographer's grey card"""
PATCH = 1
"""pixels around the given one that are averaged"""
COVERED = 250
"""8-bit value from which a pixel counts as covered"""
CLIPPED = 250
"""8-bit value from which a pixel counts as clipped"""


@dataclass(frozen=True)
class GreyCard:
    """A pixel of a card, of an image of the capture.

    Attributes:
        frame: of the motion.
        x, y: pixels from the image's top left corner.
    """

    frame: int
    x: int
    y: int

    @classmethod
    def parse(cls, text: str) -> GreyCard:
        """Of ``FRAME:X,Y``; raises ``InputError`` otherwise."""
        match = re.fullmatch(r"(\d{1,9}):(\d{1,6}),(\d{1,6})", text)
        if match is None:
            raise InputError(OPTION, expected="FRAME:X,Y, such as 12:340,220", got=text)
        return cls(*map(int, match.groups()))

    def view(self, views: Sequence[TrainingView]) -> TrainingView:
        """The training image that shows it; raises ``InputError`` if there is none."""
        for view in views:
            if view.frame.frame == self.frame:
                return view
        numbers = [view.frame.frame for view in views]
        raise InputError(OPTION, expected=f"a training frame, {min(numbers)} to {max(numbers)}", got=self.frame)

    def pixel(self, view: TrainingView, camera: Camera) -> tuple[int, int]:
        """Row and column in ``view``, a crop of ``camera``; raises ``InputError`` off the mask or if clipped."""
        scale = np.diag(view.camera.K)[:2] / np.diag(camera.K)[:2]
        column, row = np.floor(view.camera.K[:2, 2] + scale * ([self.x + 0.5, self.y + 0.5] - camera.K[:2, 2]))
        inside = PATCH <= row < len(view.mask) - PATCH and PATCH <= column < view.mask.shape[1] - PATCH
        if inside:
            patch = _patch(int(row), int(column))
            inside = bool(view.mask[patch].min() >= COVERED and view.image[patch].max() < CLIPPED)
        if not inside:
            expected, got = "a card inside the mask, not clipped", f"{self.x},{self.y}"
            raise InputError(OPTION, expected=expected, got=got, frame=self.frame)
        return int(row), int(column)


@torch.no_grad()
def card_gain(
    model: AvatarModel, view: TrainingView, pose: PoseInput, pixel: tuple[int, int], radiance: Tensor
) -> NDArray[np.float64]:
    """Factor [3] on the light ``radiance`` [32, 64, 3] under which the card at ``pixel`` reflects 18 %, neutrally.

    The card's normal is the image's where it is known, else that of the nearest Gaussian, which also gives its shadow.
    """
    row, column = pixel
    nodes = model.config.nodes
    posed = model(pose)
    visible, pixels, _ = in_sight(posed, view.camera, nodes, facing=0.1, occlusion=0.03)
    if not visible.any():
        raise InputError(OPTION, expected="a visible body", got="none", frame=view.frame.frame)
    distance = np.where(visible, np.linalg.norm(pixels - [column + 0.5, row + 0.5], axis=1), np.inf)
    nearest = int(distance.argmin())
    directions = texel_directions(*PROBE_SHAPE).reshape(-1, 3)
    spacing = float(model.spacing) * np.sqrt(len(model.points) / nodes)
    towards = torch.as_tensor(directions, dtype=torch.float32)
    means, normals = posed.means[:nodes].cpu(), posed.normals[:nodes].cpu()
    shadow = traced_visibility(means, normals, towards, spacing)[nearest].numpy()
    normal = _image_normal(view, row, column)
    normal = normals[nearest].numpy() if normal is None else normal
    share = shadow * np.maximum(directions @ normal, 0) * texel_solid_angles(*PROBE_SHAPE).reshape(-1) / np.pi
    arriving = share @ radiance.cpu().double().numpy().reshape(-1, 3)
    colour = np.asarray(srgb_to_linear(view.image[_patch(row, column)] / 255)).mean((0, 1))
    gain: NDArray[np.float64] = colour / np.maximum(CARD_REFLECTANCE * arriving, 1e-9)
    return gain


def _patch(row: int, column: int) -> tuple[slice, slice]:
    return slice(row - PATCH, row + PATCH + 1), slice(column - PATCH, column + PATCH + 1)


def _image_normal(view: TrainingView, row: int, column: int) -> NDArray[np.float64] | None:
    """Unit normal [3] in the world at a pixel of ``view``; None where it is unknown."""
    if view.normal is None or not view.normal[row, column].any():
        return None
    normal = view.normal[row, column] / 127.5 - 1
    world: NDArray[np.float64] = view.camera.world_to_camera[:3, :3].T @ normal
    return world / np.linalg.norm(world)
