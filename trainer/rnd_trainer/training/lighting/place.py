"""A known light of the place, turned about the vertical until it explains the images.

Its radiance up to one factor is known, so yaw is the only unknown: for each yaw the best albedo of every point leaves a
squared error, and the yaw of the least one is taken. The factor then follows from the albedo's level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.shading.light import REC709_LUMINANCE, Light, downsize, texel_directions, texel_solid_angles
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.probe import PROBE_SHAPE
from rnd_trainer.training.data import TrainingView

from .observations import (
    MIN_OBSERVATIONS,
    Observations,
    albedo_under,
    observe,
    point_luminance,
    transport_of,
    with_bounce,
)
from .skin import likely_gain

Floats = NDArray[np.float64]

YAWS = 512
"""yaws tried: 0.7° apart"""
SEARCH_SHAPE = (16, 32)
"""texels, 11° wide, of the light while its yaw is searched"""
FILL = 0.2
"""light from all sides, of the mean, by which reflections brighten the unlit side; without it the yaw of three captures
is found 5° to 8° nearer the camera than it is, with it 1° to 5°"""


def placed_light(
    model: AvatarModel,
    views: Sequence[TrainingView],
    poses: Sequence[PoseInput],
    place: Light,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    skin: Sequence[NDArray[np.int64]] = (),
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
    irradiance = _irradiance(observations, _at_all_yaws(place, SEARCH_SHAPE))
    at, between = divmod(_best_yaw(observations, irradiance), 1)
    radiance, arriving = (
        (1 - between) * values[..., int(at)] + between * values[..., (int(at) + 1) % YAWS]
        for values in (_at_all_yaws(place, PROBE_SHAPE), irradiance)
    )
    albedo, count = albedo_under(observations, arriving)
    gain = likely_gain(albedo, count * (count >= MIN_OBSERVATIONS), skin, tone)
    on_progress(2, 2)
    return (radiance / (gain @ REC709_LUMINANCE)).astype(np.float32)


def _at_all_yaws(place: Light, shape: tuple[int, int]) -> Floats:
    """Maps [rows, columns, 3, YAWS] of ``place`` turned about the vertical in even steps.

    Between two columns a texel's light is shared in proportion, so that a sun moves evenly.
    """
    rows, columns = shape
    fine = place.resized(YAWS // 2, YAWS) if len(place.radiance) > YAWS // 2 else place
    world = downsize(fine.sample(texel_directions(YAWS // 2, YAWS)), rows, YAWS).astype(np.float64)
    width = YAWS // columns
    maps = np.zeros((rows, columns, 3, YAWS))
    for shift in range(width):
        for offset in range(2 * width):
            weight = (1 - abs(offset - width + 0.5) / width) / width  # largest at a texel's centre, 0 at the next ones
            turned = np.roll(world, shift + width // 2 - offset, axis=1)[:, ::width]
            maps[..., shift] += weight * turned
    for texel in range(1, columns):
        maps[..., texel * width : (texel + 1) * width] = np.roll(maps[..., :width], texel, axis=1)
    return maps


def _irradiance(observations: Observations, maps: Floats) -> NDArray[np.float32]:
    """Radiance [n, 3, YAWS] of white observations under ``maps`` [16, 32, 3, YAWS], with one reflection by the body."""
    directions = texel_directions(*SEARCH_SHAPE).reshape(-1, 3)
    transport = transport_of(observations, directions, texel_solid_angles(*SEARCH_SHAPE).reshape(-1))
    direct = transport @ maps.reshape(len(directions), -1).astype(np.float32)
    return with_bounce(direct, np.maximum(1 - transport.sum(1), 0)).reshape(-1, 3, YAWS)


def _best_yaw(observations: Observations, irradiance: NDArray[np.float32]) -> float:
    """Index of the yaw in ``irradiance`` [n, 3, yaws] of the least squared error, between two by a parabola."""
    point = observations.point
    count = np.bincount(point)
    weight = point_luminance(observations) * (count[point] >= MIN_OBSERVATIONS)
    order = np.argsort(point, kind="stable")
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    explained = np.zeros(irradiance.shape[-1])
    for channel in range(3):
        light = irradiance[order, channel] + FILL * irradiance[:, channel].mean(0)
        colour = observations.colour[order, channel]
        along = np.add.reduceat((weight[order] * colour)[:, None] * light, starts, axis=0)
        power = np.add.reduceat(weight[order][:, None] * light.astype(np.float64) ** 2, starts, axis=0)
        explained += (along**2 / np.maximum(power, 1e-30)).sum(0)
    best = int(explained.argmax())
    before, at, after = (float(explained[(best + k) % len(explained)]) for k in (-1, 0, 1))
    curvature = 2 * at - before - after
    return (best + (0.5 * (after - before) / curvature if curvature > 0 else 0.0)) % len(explained)
