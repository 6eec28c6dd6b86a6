"""Light search: initial sky and directional lights from the first stage's geometry, by linear least squares.

The images are

    I_pf = albedo_p Σ_k L_k V_pfk max(n_pf · ω_k, 0) Δω_k / π        (paper, eq. 3, without the specular lobe)

Whatever the albedo of a point is, its colours over the images are parallel to its irradiance. A dictionary of sky
lobes, single directions (suns) and lobes between them (windows, a glowing horizon), all with traced shadows, is fitted
by non-negative least squares; all but the sky are added by orthogonal matching pursuit (Pati et al. 1993). Intensities
minimise the absolute error of log colours by iteratively reweighted least squares (Holland & Welsch 1977).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rnd_runtime.shading.light import REC709_LUMINANCE, texel_directions, texel_solid_angles
from rnd_trainer.config import MAX_NODES
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.probe import PROBE_SHAPE, natural_sky
from rnd_trainer.training.data import TrainingView

from .observations import (
    MIN_OBSERVATIONS,
    Observations,
    albedo_under,
    light_luminance,
    observe,
    point_luminance,
    transport_of,
    with_bounce,
)
from .skin import likely_gain

Floats = NDArray[np.float64]

SEARCH_SHAPE = (16, 32)
"""texels of the coarse search for directional lights, 11° wide"""
SKY_LOBES = 32
"""spherical Gaussians of the sky"""
SKY_SHARPNESS = 4.0
"""λ of exp(λ(cos − 1)): lobes 24° wide"""
SKY_FLOOR = 0.02
"""smallest radiance relative to the mean: the probe stores logarithms"""
WINDOW_SHARPNESS = 16.0
"""λ of windows: 14° wide"""
BROADER = 1.5
"""decrease of the error by a window, relative to that by a sun, from which on it is one: 2.0 and 3.0 where the light of
development captures is broad, up to 1.25 where it is sharp"""
MAX_LIGHTS = 3
"""suns and windows of each light of the capture"""
FIRST_GAIN = 5e-3
"""decrease of the squared error by the first directional light, relative to the geometric mean of error and energy,
below which there is none; of several lights their share. The weakest true ones of development captures have 6.3e-3; in
real videos, whose bodies and poses err, one that is not there has up to 4.1e-3"""
MIN_GAIN = 0.01
"""decrease by every further one, relative to the squared error; of several lights their share"""
MIN_REACH = 0.02
"""mean of visibility and cosine over the observations, below which a direction is no light: one behind a person who
never turned would get any strength"""
NOISE_FLOOR = 2e-3
"""squared error relative to the energy at which the search ends; that of real captures is ten times as large"""
CANDIDATES = 24
"""directions with the largest gradient that are fitted before one is chosen"""
ROUND_OFF = 1e-5
"""unexplained share of the irradiance that is float32 rounding"""
RIDGE = 1e-4
"""relative ridge of the normal equations: neighbouring lobes are nearly collinear"""
REWEIGHTINGS = 10
"""iterations of reweighted least squares"""
ERROR_FLOOR = 0.1
"""relative error of a colour below which its weight is constant"""
SKY_PRIOR = 1.0
"""relative weight of the natural sky"""
PENALTY = 30.0
"""relative weight of the constraint that fixes the scale of the light"""


@dataclass
class InitialLight:
    """Initial light."""

    radiance: NDArray[np.float32]  # [lights, 32, 64, 3] linear
    exposure: NDArray[np.float32]
    """[lights, 32, 64] mean radiance of a visible white body, over all images, per unit radiance of a texel"""


def initial_light(
    model: AvatarModel,
    views: Sequence[TrainingView],
    poses: Sequence[PoseInput],
    lights: Sequence[int] = (),
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    skin: Sequence[NDArray[np.int64]] = (),
    tone: float | None = None,
) -> InitialLight | None:
    """The lights that best explain the images; None if the body is hardly visible, or only from one side.

    Several are searched jointly: points have one albedo under all of them, so their ratios come from the images. The
    one factor per channel that lights and albedo share is ``skin.likely_gain``'s.

    Args:
        model: after the first stage.
        views, poses: of the training images.
        lights: index of the light of each image; empty: all have one.
        skin: indices of points that may be skin, by place.
        tone: known reflectance of the skin.
        on_progress: called with done and total.
    """
    steps = iter(range(1, 6))

    def advance() -> None:
        on_progress(next(steps), 5)

    on_progress(0, 5)
    observations = observe(model, views, poses, lights)
    advance()
    if len(observations.point) == 0:
        return None
    reliable = np.bincount(observations.point)[observations.point] >= MIN_OBSERVATIONS
    if np.count_nonzero(reliable) < 10 * SKY_LOBES:
        return None
    weight = point_luminance(observations) * reliable / light_luminance(observations) ** 2
    directions, solid_angles = _grid(PROBE_SHAPE)
    coarse_directions, coarse_angles = _grid(SEARCH_SHAPE)
    coarse = transport_of(observations, coarse_directions, coarse_angles)
    exposure = _exposure(observations, coarse) / _upsampled(coarse_angles) * solid_angles
    possible = (coarse_directions[:, 1] > 0) & (coarse.mean(0) > MIN_REACH * coarse_angles / np.pi)
    hidden = np.maximum(1 - coarse.sum(1), 0)
    coarse = with_bounce(coarse, hidden)
    blocks, skies = observations.blocks, SKY_LOBES * observations.lights
    sky = blocks(coarse @ _sky(coarse_directions).astype(np.float32))
    of_windows = coarse @ _lobes(coarse_directions, coarse_directions, WINDOW_SHARPNESS).astype(np.float32)
    others = blocks(np.concatenate([coarse, of_windows], axis=1))
    quadratic = _quadratic(observations, np.concatenate([sky, others], axis=1), weight)
    advance()
    if quadratic.is_undetermined():
        return None
    found = (np.array(_search(quadratic, possible, possible), int) - skies) % (2 * len(coarse_directions))
    advance()
    windows = np.unique(found[found >= len(coarse_directions)]) - len(coarse_directions)
    near_texels = _texels_near(directions, coarse_directions[found[found < len(coarse_directions)]])
    fine = with_bounce(transport_of(observations, directions[near_texels], solid_angles[near_texels]), hidden)
    columns = np.concatenate([sky, blocks(np.concatenate([fine, of_windows[:, windows]], axis=1))], axis=1)
    maps = np.zeros((len(near_texels) + len(windows), len(directions)))  # radiance of each column after the sky's
    maps[np.arange(len(near_texels)), near_texels] = 1
    maps[len(near_texels) :] = _lobes(directions, coarse_directions[windows], WINDOW_SHARPNESS).T
    chosen = _search(_quadratic(observations, columns, weight), _upsampled(possible)[near_texels], possible[windows])
    advance()
    intensity = _intensities(observations, columns[:, [*range(skies), *chosen]])
    advance()
    radiance = np.stack([_sky(directions) @ block for block in np.split(intensity[:skies], observations.lights)])
    radiance = np.maximum(radiance, SKY_FLOOR * radiance.mean((1, 2), keepdims=True))
    observed = np.unique(observations.light())
    radiance[np.setdiff1d(np.arange(len(radiance)), observed)] = radiance[observed].mean(0)
    for column, of_column in zip(chosen, intensity[skies:]):
        light, shape = divmod(column - skies, len(maps))
        radiance[light] += maps[shape, :, None] * of_column
    irradiance = columns[:, [*range(skies), *chosen]] @ intensity
    albedo, weight = albedo_under(observations, irradiance)
    radiance /= likely_gain(albedo, weight * (weight >= MIN_OBSERVATIONS), skin, tone)
    return InitialLight(
        radiance.reshape(-1, *PROBE_SHAPE, 3).astype(np.float32), exposure.reshape(-1, *PROBE_SHAPE).astype(np.float32)
    )


def warm_up() -> None:
    """Fit a sky to random data: linear algebra allocates its buffers."""
    rng = np.random.default_rng(0)
    transport = rng.random((8 * MAX_NODES, SKY_LOBES + 2 * math.prod(SEARCH_SHAPE)), dtype=np.float32)
    colour, point = 0.1 + rng.random((len(transport), 3)), np.arange(len(transport)) % MAX_NODES
    observations = Observations(point, colour, np.zeros(len(point), np.int64), [], 0.0)
    _quadratic(observations, transport, point_luminance(observations)).fit(range(SKY_LOBES))


@dataclass
class Quadratic:
    """Squared error Lᵀ residual_gram L of a light L, per channel, over Q columns of the dictionary.

    The first are the sky lobes of each of the lights.
    """

    residual_gram: Floats  # [3, Q, Q]
    irradiance_gram: Floats  # [Q, Q]; Lᵀ irradiance_gram L is the squared irradiance
    irradiance: Floats  # [Q]; irradiance · L is the total irradiance
    lights: int = 1

    @property
    def skies(self) -> int:
        """Number of sky lobes."""
        return SKY_LOBES * self.lights

    def is_undetermined(self) -> bool:
        """Whether the observations do not constrain the light."""
        unexplained = float(np.trace(self.residual_gram.mean(0)))
        return unexplained < ROUND_OFF * float(np.trace(self.irradiance_gram))

    def fit(self, columns: Sequence[int]) -> tuple[float, Floats]:
        """Least error, and its non-negative intensities [len(columns), 3], under the constraint irradiance · L = 1."""
        selected = np.asarray(columns)
        weight = PENALTY * math.sqrt(float(np.trace(self.residual_gram.mean(0)))) / np.linalg.norm(self.irradiance)
        intensity, error = np.empty((len(selected), 3)), 0.0
        for channel in range(3):
            gram = self.residual_gram[channel][np.ix_(selected, selected)]
            gram = gram + np.diag(RIDGE * np.diag(gram) + 1e-12)
            expected = natural_sky(_lobe_centres()[:, 1])
            for first in range(0, self.skies, SKY_LOBES):  # always among the columns
                sky = slice(first, first + SKY_LOBES)
                level = SKY_PRIOR * float(np.diag(gram)[sky].mean())
                gram[sky, sky] += level * (np.eye(SKY_LOBES) - np.outer(expected, expected) / (expected @ expected))
            factor = np.linalg.cholesky(gram).T  # ‖factor L‖² is the error
            equations = np.concatenate([factor, weight * self.irradiance[None, selected]])
            target = np.append(np.zeros(len(selected)), weight)
            intensity[:, channel], _ = nnls(equations, target)
            intensity[:, channel] /= self.irradiance[selected] @ intensity[:, channel]
            error += float(
                intensity[:, channel] @ self.residual_gram[channel][np.ix_(selected, selected)] @ intensity[:, channel]
            )
        return error, intensity

    def gains(self, columns: Sequence[int], intensity: Floats) -> Floats:
        """Decrease of the error [Q] per light moved into each column, normalised by the column."""
        selected = np.asarray(columns)
        gain = np.zeros(len(self.irradiance))
        for channel in range(3):
            matrix = self.residual_gram[channel]
            gradient = matrix[:, selected] @ intensity[:, channel]
            level = intensity[:, channel] @ gradient[selected]  # Lagrange multiplier of irradiance · L = 1
            gain += (level * self.irradiance - gradient) / np.sqrt(np.diag(matrix) + 1e-12)
        return gain


def _quadratic(observations: Observations, transport: NDArray[np.float32], weight: Floats) -> Quadratic:
    """Quadratic form of ``transport`` [n, Q] with ``weight`` [n], the albedo eliminated.

    With I_p the colours and T_p L the irradiance of point p in its images, the best albedo leaves
    ‖(1 − Î_p Î_pᵀ) T_p L‖.
    """
    count, columns = int(observations.point.max()) + 1, transport.shape[1]
    sqrt_weight = np.sqrt(weight)
    rows = transport * sqrt_weight[:, None].astype(transport.dtype)
    irradiance_gram = (rows.T @ rows).astype(np.float64)
    order = np.argsort(observations.point, kind="stable")
    starts = np.flatnonzero(np.diff(observations.point[order], prepend=-1))
    residual_gram = np.empty((3, columns, columns))
    for channel in range(3):
        colour = observations.colour[:, channel] * sqrt_weight
        length = np.sqrt(np.bincount(observations.point, colour**2, count))
        unit = (colour / np.maximum(length[observations.point], 1e-9)).astype(rows.dtype)
        along = np.add.reduceat((rows * unit[:, None])[order], starts, axis=0).astype(np.float64)
        residual_gram[channel] = irradiance_gram - along.T @ along
    return Quadratic(residual_gram, irradiance_gram, rows.sum(0, dtype=np.float64), observations.lights)


def _intensities(observations: Observations, columns: NDArray[np.float32]) -> Floats:
    """Intensities [Q, 3] of all columns that minimise the absolute error of log colours."""
    all_columns = list(range(columns.shape[1]))
    _, intensity = _quadratic(observations, columns, point_luminance(observations)).fit(all_columns)
    colour = np.log(np.maximum(observations.colour @ REC709_LUMINANCE, 1e-4))
    count, weight = int(observations.point.max()) + 1, np.ones(len(colour))
    for _ in range(REWEIGHTINGS):
        light = columns @ (intensity @ REC709_LUMINANCE)
        light = np.maximum(light / light.mean(), 1e-3)
        weighted = np.bincount(observations.point, weight * (colour - np.log(light)), count)
        albedo = weighted / np.maximum(np.bincount(observations.point, weight, count), 1e-12)
        error = np.abs(colour - np.log(light) - albedo[observations.point])
        weight = 1 / np.maximum(error, ERROR_FLOOR)
        _, intensity = _quadratic(observations, columns, weight / light**2).fit(all_columns)
    return intensity


def _search(quadratic: Quadratic, suns: NDArray[np.bool_], windows: NDArray[np.bool_]) -> list[int]:
    """Columns of suns and windows, in the order in which they are added.

    ``suns`` and ``windows`` tell which of those of each light, its columns after the sky's, are possible.
    Errors blur, so a window must explain much more than a sun does, and as much as a first one must.

    Without shadows a direction and its opposite have similar gradients: above degree 1 the SH coefficients of a cosine
    lobe are even only (Ramamoorthi & Hanrahan 2001). ``CANDIDATES`` are therefore fitted.
    """
    skies, lights = quadratic.skies, quadratic.lights
    no_sky, no_suns, no_windows = (np.zeros(n, bool) for n in (skies, len(suns), len(windows)))
    is_sun = np.append(no_sky, np.tile(np.append(suns, no_windows), lights))
    is_window = np.append(no_sky, np.tile(np.append(no_suns, windows), lights))
    columns = list(range(skies))
    before, intensity = quadratic.fit(columns)
    sky = slice(0, skies)
    energy = float(np.einsum("qc,qr,rc", intensity, quadratic.irradiance_gram[sky, sky], intensity))
    noise = NOISE_FLOOR / lights * energy
    while len(columns) < min(skies + MAX_LIGHTS * lights, len(quadratic.irradiance)) and before > noise:
        gain = quadratic.gains(columns, intensity)
        gain[columns] = -np.inf
        after, best = _best(quadratic, columns, np.where(is_sun, gain, -np.inf))
        broad, widest = _best(quadratic, columns, np.where(is_window, gain, -np.inf))
        first = FIRST_GAIN * math.sqrt(before * energy) / lights
        least = MIN_GAIN * before / lights if len(columns) > skies else first
        if before - broad > max(BROADER * (before - after), first):
            after, best = broad, widest
        if before - after < least:
            break
        columns.append(best)
        before, intensity = quadratic.fit(columns)
    return columns[skies:]


def _best(quadratic: Quadratic, columns: list[int], gain: Floats) -> tuple[float, int]:
    """Least error with one column more, of the ``CANDIDATES`` of greatest ``gain`` [Q], and that column."""
    tried = [k for k in np.argsort(-gain)[:CANDIDATES].tolist() if gain[k] > -np.inf]
    return min(((quadratic.fit([*columns, k])[0], k) for k in tried), default=(math.inf, -1))


def _grid(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    return texel_directions(*shape).reshape(-1, 3), texel_solid_angles(*shape).reshape(-1)


def _exposure(observations: Observations, coarse: NDArray[np.float32]) -> Floats:
    """Mean of ``coarse`` [n, K], over all observations and by lights, at the probe's texels: [lights, 2048]."""
    own = np.eye(observations.lights)[observations.light()]
    return _upsampled(own.T @ coarse / len(coarse))


def _upsampled(values: NDArray[Any]) -> NDArray[Any]:
    """Maps [..., 512] of the search's texels, repeated to the probe's [..., 2048]."""
    rows, columns = (fine // coarse for fine, coarse in zip(PROBE_SHAPE, SEARCH_SHAPE, strict=True))
    maps = values.reshape(*values.shape[:-1], *SEARCH_SHAPE).repeat(rows, -2).repeat(columns, -1)
    return maps.reshape(*values.shape[:-1], -1)


def _lobe_centres() -> Floats:
    """Unit directions [SKY_LOBES, 3] of a Fibonacci lattice."""
    k = np.arange(SKY_LOBES) + 0.5
    y, azimuth = 1 - 2 * k / SKY_LOBES, k * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - y**2)
    return np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], axis=1)


def _sky(directions: Floats) -> Floats:
    """Sky lobes [K, SKY_LOBES] at ``directions`` [K, 3]."""
    return _lobes(directions, _lobe_centres(), SKY_SHARPNESS)


def _lobes(directions: Floats, centres: Floats, sharpness: float) -> Floats:
    """Spherical Gaussians [K, C] around ``centres`` [C, 3] at ``directions`` [K, 3]."""
    return np.exp(sharpness * (directions @ centres.T - 1))


def _texels_near(directions: Floats, centres: Floats) -> NDArray[np.int64]:
    """Indices of the texels within 1.5 search texels of any of ``centres`` [C, 3]."""
    if len(centres) == 0:
        return np.empty(0, np.int64)
    reach = 1.5 * math.pi / SEARCH_SHAPE[0]
    return np.nonzero((directions @ centres.T).max(1) > math.cos(reach))[0]
