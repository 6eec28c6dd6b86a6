"""Observations of body points in the training images, and the light that reaches them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from rnd_runtime.core.arrays import spaced_indices
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.shading.light import REC709_LUMINANCE
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.in_sight import in_sight
from rnd_trainer.render.shading import traced_visibility
from rnd_trainer.training.data import TrainingView

from .skin import BODY_LUMINANCE

Floats = NDArray[np.float64]

FRAMES = 40
"""images observed, evenly spaced"""
FACING = 0.3
"""smallest cosine between normal and view of an observation; light from behind is seen on rims alone"""
OCCLUSION = 0.03
"""distance behind the first surface up to which a point is visible, m"""
MIN_OBSERVATIONS = 3
"""observations of a point that is used: with one or two its unknown albedo explains any light"""


@dataclass
class Observations:
    """n observations of body points."""

    point: NDArray[np.int64]  # [n] index
    colour: Floats  # [n, 3] linear
    image: NDArray[np.int64]  # [n] index
    posed: list[tuple[torch.Tensor, torch.Tensor]]
    """means and normals of the points in each image; of those observed, of the surface that the pixel shows"""
    spacing: float  # m
    light_of_image: Sequence[int] = ()  # index of each image's light; empty: all have one

    @property
    def lights(self) -> int:
        return max(self.light_of_image, default=0) + 1

    def light(self) -> NDArray[np.int64]:
        """Index of the light of each observation [n]."""
        return np.array(self.light_of_image or [0] * len(self.posed))[self.image]

    def blocks(self, columns: NDArray[np.float32]) -> NDArray[np.float32]:
        """``columns`` [n, Q] of any light as columns [n, lights · Q], zero but for the observation's own light."""
        own = np.eye(self.lights, dtype=columns.dtype)[self.light()]
        return (own[:, :, None] * columns[:, None, :]).reshape(len(columns), -1)


def observe(
    model: AvatarModel, views: Sequence[TrainingView], poses: Sequence[PoseInput], lights: Sequence[int]
) -> Observations:
    """Colours of the nodes where they are visible, inside the mask and not clipped."""
    nodes = model.config.nodes
    spacing = float(model.spacing) * math.sqrt(len(model.points) / nodes)
    of_light = np.array(lights or [0] * len(views))
    groups = [np.flatnonzero(of_light == k) for k in np.unique(of_light)]
    chosen = np.sort(np.concatenate([group[spaced_indices(len(group), FRAMES)] for group in groups]))
    point, colour, image, posed_nodes = [], [], [], []
    for k, index in enumerate(chosen):
        view, camera = views[index], views[index].camera
        with torch.no_grad():
            posed = model(poses[index])
        sight = in_sight(posed, camera, nodes, facing=FACING, occlusion=OCCLUSION)
        column, row = sight.pixels.astype(int).T
        pixels = view.image[row, column]
        unclipped = (view.mask[row, column] == 255) & (pixels.max(1) < 250)
        usable = np.nonzero(sight.visible & unclipped)[0]
        point.append(usable)
        colour.append(np.asarray(srgb_to_linear(pixels[usable] / 255), np.float64))
        image.append(np.full(len(usable), k))
        normals = posed.normals[:nodes].cpu().clone()
        normals[usable] = torch.from_numpy(sight.normals[usable])
        posed_nodes.append((posed.means[:nodes].cpu(), normals))
    points, colours, images = np.concatenate(point), np.concatenate(colour), np.concatenate(image)
    return Observations(points, colours, images, posed_nodes, spacing, of_light[chosen].tolist())


def transport_of(observations: Observations, directions: Floats, solid_angles: Floats) -> NDArray[np.float32]:
    """[n, K] radiance of white observations per unit radiance from each direction, shadows traced."""
    towards = torch.as_tensor(directions, dtype=torch.float32)
    rows = []
    for k, (means, normals) in enumerate(observations.posed):
        point = observations.point[observations.image == k]
        visible = traced_visibility(means, normals, towards, observations.spacing)[point]
        rows.append((visible * (normals[point] @ towards.T).clamp(min=0)).numpy())
    return np.concatenate(rows) * (solid_angles / np.pi).astype(np.float32)


def with_bounce(transport: NDArray[np.float32], hidden: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transport [n, K] with one reflection: the hidden share [n] of the hemisphere is as bright as the mean body.

    Without it the light from below and behind, where limbs face each other, comes out 1.2 to 1.6 times too strong.
    """
    reflected: NDArray[np.float32] = transport + BODY_LUMINANCE * hidden[:, None] * transport.mean(0)
    return reflected


def point_luminance(observations: Observations) -> Floats:
    """Mean luminance of each observation's point [n], the weight of its error."""
    count = np.maximum(np.bincount(observations.point), 1)
    return (np.bincount(observations.point, observations.colour @ REC709_LUMINANCE) / count)[observations.point]


def light_luminance(observations: Observations) -> Floats:
    """Mean luminance of each observation's light [n] over that of all: lights count alike, however bright."""
    light, luminance = observations.light(), observations.colour @ REC709_LUMINANCE
    means = np.bincount(light, luminance) / np.maximum(np.bincount(light), 1)
    return means[light] / luminance.mean()


def albedo_under(observations: Observations, irradiance: Floats) -> tuple[Floats, Floats]:
    """Least-squares albedo [P, 3] of every point under ``irradiance`` [n, 3], and its number of observations [P]."""
    point = observations.point
    albedo = [
        np.bincount(point, colour * light) / np.maximum(np.bincount(point, light**2), 1e-12)
        for colour, light in zip(observations.colour.T, irradiance.T, strict=True)
    ]
    return np.stack(albedo, axis=1), np.bincount(point).astype(float)
