"""A known light of the place, turned about the vertical until it explains the images.

Its radiance up to one factor is known, so yaw is the only unknown: for each yaw the best albedo of every point leaves a
squared error, and the yaw of the least one is taken. The factor then follows from the albedo's level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from rnd_runtime.shading.light import REC709_LUMINANCE, Light, downsize, texel_directions, texel_solid_angles
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.probe import PROBE_SHAPE
from rnd_trainer.render.shading import traced_visibility
from rnd_trainer.training.data import TrainingView

from .observations import Observations, albedo_under, observe, point_luminance
from .skin import BODY_LUMINANCE, likely_gain

Floats = NDArray[np.float64]

SHIFTS = 8
"""yaws per texel of the probe: 0.7° apart"""
MIN_OBSERVATIONS = 3
"""observations of a point that is used: the albedo explains fewer under any light"""


def placed_light(
    model: AvatarModel,
    views: Sequence[TrainingView],
    poses: Sequence[PoseInput],
    place: Light,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    skin: NDArray[np.int64] | None = None,
    tone: float | None = None,
) -> NDArray[np.float32] | None:
    """Radiance [32, 64, 3] of ``place``, turned and scaled to the images; None if the body is hardly visible.

    Args:
        model: after the first stage.
        views, poses: of the training images, all under this light.
        place: its yaw and scale are ignored, its colour is kept.
        on_progress: called with done and total.
        skin, tone: as of ``light_search.initial_light``; they give the scale.
    """
    on_progress(0, 2)
    observations = observe(model, views, poses, ())
    on_progress(1, 2)
    if not (np.bincount(observations.point, minlength=1) >= MIN_OBSERVATIONS).any():
        return None
    maps = _shifted(place)
    irradiance = _irradiance(observations, maps)
    yaw = _best_yaw(observations, irradiance)
    at, between = divmod(yaw, 1)
    radiance, arriving = (
        (1 - between) * values[..., int(at)] + between * values[..., (int(at) + 1) % values.shape[-1]]
        for values in (_all_yaws(maps), irradiance)
    )
    albedo, count = albedo_under(observations, arriving)
    gain = likely_gain(albedo, count * (count >= MIN_OBSERVATIONS), [] if skin is None else skin, tone)
    on_progress(2, 2)
    return (radiance / (gain @ REC709_LUMINANCE)).astype(np.float32)


def _shifted(place: Light) -> Floats:
    """Maps [32, 64, 3, SHIFTS] of ``place``, each turned by a further 1 / ``SHIFTS`` of a texel.

    Between two columns a texel's light is shared in proportion, so that a sun moves evenly.
    """
    rows, columns = PROBE_SHAPE
    size = (SHIFTS * columns // 2, SHIFTS * columns)
    fine = place.resized(*size) if len(place.radiance) > size[0] else place
    world = downsize(fine.sample(texel_directions(*size)), rows, SHIFTS * columns).astype(np.float64)
    offsets = np.arange(2 * SHIFTS)
    tent = 1 - np.abs(offsets - SHIFTS + 0.5) / SHIFTS  # 1 at a texel's centre, 0 at those of its neighbours
    maps = np.zeros((rows, columns, 3, SHIFTS))
    for shift in range(SHIFTS):
        for offset, weight in zip(offsets, tent, strict=True):
            turned = np.roll(world, shift + SHIFTS // 2 - offset, axis=1)
            maps[..., shift] += weight / SHIFTS * turned[:, ::SHIFTS]
    return maps


def _all_yaws(maps: Floats) -> Floats:
    """Maps [32, 64, 3, yaws] at all yaws of ``maps`` [32, 64, 3, SHIFTS], in order."""
    turned = [np.roll(maps, texel, axis=1) for texel in range(PROBE_SHAPE[1])]
    return np.concatenate(turned, axis=-1)


def _irradiance(observations: Observations, maps: Floats) -> NDArray[np.float32]:
    """Radiance [n, 3, yaws] of white observations, with one reflection by the body."""
    lights = torch.as_tensor(_all_yaws(maps).reshape(-1, 3, PROBE_SHAPE[1] * SHIFTS), dtype=torch.float32)
    towards = torch.as_tensor(texel_directions(*PROBE_SHAPE).reshape(-1, 3), dtype=torch.float32)
    share = torch.as_tensor(texel_solid_angles(*PROBE_SHAPE).reshape(-1) / np.pi, dtype=torch.float32)
    rows, hidden = [], []
    for k, (means, normals) in enumerate(observations.posed):
        point = observations.point[observations.image == k]
        visible = traced_visibility(means, normals, towards, observations.spacing)[point]
        transport = visible * (normals[point] @ towards.T).clamp(min=0) * share
        rows.append((transport @ lights.flatten(1)).unflatten(1, lights.shape[1:]).numpy())
        hidden.append((1 - transport.sum(1)).clamp(min=0).numpy())
    direct = np.concatenate(rows)
    reflected: NDArray[np.float32] = direct + BODY_LUMINANCE * np.concatenate(hidden)[:, None, None] * direct.mean(0)
    return reflected


def _best_yaw(observations: Observations, irradiance: NDArray[np.float32]) -> float:
    """Index of the yaw in ``irradiance`` [n, 3, yaws] of the least squared error, between two by a parabola."""
    point = observations.point
    count = np.bincount(point)
    weight = point_luminance(observations) * (count[point] >= MIN_OBSERVATIONS)
    order = np.argsort(point, kind="stable")
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    explained = np.zeros(irradiance.shape[-1])
    for channel in range(3):
        light, colour = irradiance[order, channel], observations.colour[order, channel]
        along = np.add.reduceat((weight[order] * colour)[:, None] * light, starts, axis=0)
        power = np.add.reduceat(weight[order][:, None] * light.astype(np.float64) ** 2, starts, axis=0)
        explained += (along**2 / np.maximum(power, 1e-30)).sum(0)
    best = int(explained.argmax())
    before, at, after = (float(explained[(best + k) % len(explained)]) for k in (-1, 0, 1))
    curvature = 2 * at - before - after
    return (best + (0.5 * (after - before) / curvature if curvature > 0 else 0.0)) % len(explained)
