"""Light search: initial sky and directional lights from the first stage's geometry, by linear least squares.

The images are

    I_pf = albedo_p Σ_k L_k V_pfk max(n_pf · ω_k, 0) Δω_k / π        (paper, eq. 3, without the specular lobe)

Whatever the albedo of a point is, its colours over the images are parallel to its irradiance. A dictionary of broad
lobes (sky) and single directions with traced shadows is fitted by non-negative least squares; directions are added by
orthogonal matching pursuit (Pati et al. 1993). Intensities minimise the absolute error of log colours by iteratively
reweighted least squares (Holland & Welsch 1977).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.shading.light import REC709_LUMINANCE, texel_directions, texel_solid_angles
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.render.in_sight import in_sight
from rnd_trainer.render.probe import PROBE_SHAPE, natural_sky
from rnd_trainer.render.shading import traced_visibility
from rnd_trainer.training.data import TrainingView

from .skin import BODY_LUMINANCE, likely_gain

Floats = NDArray[np.float64]

SEARCH_SHAPE = (16, 32)
"""texels of the coarse search for directional lights, 11° wide"""
SKY_LOBES = 32
"""spherical Gaussians of the sky"""
SKY_SHARPNESS = 4.0
"""λ of exp(λ(cos − 1)): lobes 24° wide"""
SKY_FLOOR = 0.02
"""smallest radiance relative to the mean: the probe stores logarithms"""
MAX_LIGHTS = 3
"""directional lights"""
MIN_GAIN = 0.01
"""relative decrease of the squared error below which no directional light is added"""
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
POINTS = 3_000
"""nodes observed"""
FRAMES = 40
"""images observed, evenly spaced"""
FACING = 0.3
"""smallest cosine between normal and view of an observation"""
MIN_OBSERVATIONS = 3
"""observations of a point that is used: with one or two its unknown albedo explains any light"""
OCCLUSION = 0.03
"""distance behind the first surface up to which a point is visible, m"""


@dataclass
class InitialLight:
    """Initial light."""

    radiance: NDArray[np.float32]  # [32, 64, 3] linear
    exposure: NDArray[np.float32]  # [32, 64] mean radiance of a visible white body per unit radiance of a texel


@dataclass
class Observations:
    """n observations of body points."""

    point: NDArray[np.int64]  # [n] index
    colour: Floats  # [n, 3] linear
    image: NDArray[np.int64]  # [n] index
    posed: list[tuple[torch.Tensor, torch.Tensor]]  # means and normals of the points in each image
    spacing: float  # m


def initial_light(
    model: AvatarModel,
    views: Sequence[TrainingView],
    poses: Sequence[PoseInput],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    skin: NDArray[np.int64] | None = None,
    tone: float | None = None,
) -> InitialLight | None:
    """The light that best explains the images; None if the body is hardly visible, or only from one side.

    The factor per channel that light and albedo share is ``skin.likely_gain``'s.

    Args:
        model: after the first stage.
        views, poses: of the training images.
        skin: indices of points that may be skin; None: none.
        tone: known reflectance of the skin.
        on_progress: called with done and total.
    """
    steps = iter(range(1, 6))

    def advance() -> None:
        on_progress(next(steps), 5)

    on_progress(0, 5)
    observations = _observe(model, views, poses)
    advance()
    if len(observations.point) == 0:
        return None
    reliable = np.bincount(observations.point)[observations.point] >= MIN_OBSERVATIONS
    if np.count_nonzero(reliable) < 10 * SKY_LOBES:
        return None
    weight = _point_luminance(observations) * reliable
    directions, solid_angles = _grid(PROBE_SHAPE)
    coarse_directions, coarse_angles = _grid(SEARCH_SHAPE)
    coarse = _transport(observations, coarse_directions, coarse_angles)
    exposure = _upsample(coarse.mean(0) / coarse_angles) * solid_angles
    hidden = np.maximum(1 - coarse.sum(1), 0)
    coarse = _with_bounce(coarse, hidden)
    sky = coarse @ _lobes(coarse_directions).astype(np.float32)
    quadratic = _quadratic(observations, np.concatenate([sky, coarse], axis=1), weight)
    advance()
    if quadratic.is_undetermined():
        return None
    coarse_lights = _search(quadratic)
    advance()
    near_texels = _texels_near(directions, coarse_directions[np.array(coarse_lights, int) - SKY_LOBES])
    fine = _with_bounce(_transport(observations, directions[near_texels], solid_angles[near_texels]), hidden)
    columns = np.concatenate([sky, fine], axis=1)
    lights = _search(_quadratic(observations, columns, weight))
    advance()
    intensity = _intensities(observations, columns[:, [*range(SKY_LOBES), *lights]])
    advance()
    radiance = _lobes(directions) @ intensity[:SKY_LOBES]
    radiance = np.maximum(radiance, SKY_FLOOR * radiance.mean())
    radiance[near_texels[np.array(lights, int) - SKY_LOBES]] += intensity[SKY_LOBES:]
    irradiance = columns[:, [*range(SKY_LOBES), *lights]] @ intensity
    albedo, weight = _albedo(observations, irradiance)
    radiance /= likely_gain(albedo, weight * (weight >= MIN_OBSERVATIONS), [] if skin is None else skin, tone)
    return InitialLight(
        radiance.reshape(*PROBE_SHAPE, 3).astype(np.float32), exposure.reshape(PROBE_SHAPE).astype(np.float32)
    )


def warm_up() -> None:
    """Fit a sky to random data: linear algebra allocates its buffers."""
    rng = np.random.default_rng(0)
    transport = rng.random((8 * POINTS, SKY_LOBES + math.prod(SEARCH_SHAPE)), dtype=np.float32)
    colour, point = 0.1 + rng.random((len(transport), 3)), np.arange(len(transport)) % POINTS
    observations = Observations(point, colour, np.zeros(len(point), np.int64), [], 0.0)
    _quadratic(observations, transport, _point_luminance(observations)).fit(range(SKY_LOBES))


def _observe(model: AvatarModel, views: Sequence[TrainingView], poses: Sequence[PoseInput]) -> Observations:
    """Colours of the first nodes where they are visible, inside the mask and not clipped."""
    nodes = min(POINTS, model.config.nodes)
    spacing = float(model.spacing) * math.sqrt(len(model.points) / nodes)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(FRAMES, len(views))).astype(int))
    point, colour, image, posed_nodes = [], [], [], []
    for k, index in enumerate(chosen):
        view, camera = views[index], views[index].camera
        with torch.no_grad():
            posed = model(poses[index])
        visible, pixel = in_sight(posed, camera, nodes, facing=FACING, occlusion=OCCLUSION)
        column, row = pixel.astype(int).T
        pixels = view.image[row, column]
        unclipped = (view.mask[row, column] == 255) & (pixels.max(1) < 250)
        usable = np.nonzero(visible & unclipped)[0]
        point.append(usable)
        colour.append(srgb_to_linear(pixels[usable] / 255))
        image.append(np.full(len(usable), k))
        posed_nodes.append((posed.means[:nodes].cpu(), posed.normals[:nodes].cpu()))
    return Observations(np.concatenate(point), np.concatenate(colour), np.concatenate(image), posed_nodes, spacing)


def _transport(observations: Observations, directions: Floats, solid_angles: Floats) -> NDArray[np.float32]:
    """[n, K] radiance of white observations per unit radiance from each direction, shadows traced."""
    towards = torch.as_tensor(directions, dtype=torch.float32)
    rows = []
    for k, (means, normals) in enumerate(observations.posed):
        point = observations.point[observations.image == k]
        visible = traced_visibility(means, normals, towards, observations.spacing)[point]
        rows.append((visible * (normals[point] @ towards.T).clamp(min=0)).numpy())
    return np.concatenate(rows) * (solid_angles / np.pi).astype(np.float32)


def _with_bounce(transport: NDArray[np.float32], hidden: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transport [n, K] with one reflection: the hidden share [n] of the hemisphere is as bright as the mean body.

    Without it the light from below and behind, where limbs face each other, comes out 1.2 to 1.6 times too strong.
    """
    reflected: NDArray[np.float32] = transport + BODY_LUMINANCE * hidden[:, None] * transport.mean(0)
    return reflected


@dataclass
class Quadratic:
    """Squared error Lᵀ residual_gram L of a light L, per channel, over Q columns of the dictionary."""

    residual_gram: Floats  # [3, Q, Q]
    irradiance_gram: Floats  # [Q, Q]; Lᵀ irradiance_gram L is the squared irradiance
    irradiance: Floats  # [Q]; irradiance · L is the total irradiance

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
            sky = slice(0, SKY_LOBES)  # always among the columns
            level = SKY_PRIOR * float(np.diag(gram)[sky].mean())
            expected = natural_sky(_lobe_centres()[:, 1])
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


def _point_luminance(observations: Observations) -> Floats:
    """Mean luminance of each observation's point [n], the weight of its error."""
    count = np.maximum(np.bincount(observations.point), 1)
    return (np.bincount(observations.point, observations.colour @ REC709_LUMINANCE) / count)[observations.point]


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
    return Quadratic(residual_gram, irradiance_gram, rows.sum(0, dtype=np.float64))


def _intensities(observations: Observations, columns: NDArray[np.float32]) -> Floats:
    """Intensities [Q, 3] of all columns that minimise the absolute error of log colours."""
    all_columns = list(range(columns.shape[1]))
    _, intensity = _quadratic(observations, columns, _point_luminance(observations)).fit(all_columns)
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


def _albedo(observations: Observations, irradiance: Floats) -> tuple[Floats, Floats]:
    """Least-squares albedo [P, 3] of every point under ``irradiance`` [n, 3], and its number of observations [P]."""
    point = observations.point
    albedo = [
        np.bincount(point, colour * light) / np.maximum(np.bincount(point, light**2), 1e-12)
        for colour, light in zip(observations.colour.T, irradiance.T, strict=True)
    ]
    return np.stack(albedo, axis=1), np.bincount(point).astype(float)


def _search(quadratic: Quadratic) -> list[int]:
    """Columns of the directional lights, in the order in which they are added.

    Without shadows a direction and its opposite have similar gradients: above degree 1 the SH coefficients of a cosine
    lobe are even only (Ramamoorthi & Hanrahan 2001). ``CANDIDATES`` are therefore fitted.
    """
    columns = list(range(SKY_LOBES))
    before, intensity = quadratic.fit(columns)
    sky = slice(0, SKY_LOBES)
    noise = NOISE_FLOOR * float(np.einsum("qc,qr,rc", intensity, quadratic.irradiance_gram[sky, sky], intensity))
    while len(columns) < min(SKY_LOBES + MAX_LIGHTS, len(quadratic.irradiance)) and before > noise:
        gain = quadratic.gains(columns, intensity)
        gain[columns] = -np.inf
        tried = [(quadratic.fit([*columns, int(k)])[0], int(k)) for k in np.argsort(-gain)[:CANDIDATES]]
        after, best = min(tried)
        if before - after < MIN_GAIN * before:
            break
        columns.append(best)
        before, intensity = quadratic.fit(columns)
    return columns[SKY_LOBES:]


def _grid(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    return texel_directions(*shape).reshape(-1, 3), texel_solid_angles(*shape).reshape(-1)


def _upsample(values: Floats) -> Floats:
    """A map [K] of the search's texels, repeated to the probe's."""
    rows, columns = (fine // coarse for fine, coarse in zip(PROBE_SHAPE, SEARCH_SHAPE, strict=True))
    return values.reshape(SEARCH_SHAPE).repeat(rows, 0).repeat(columns, 1).reshape(-1)


def _lobe_centres() -> Floats:
    """Unit directions [SKY_LOBES, 3] of a Fibonacci lattice."""
    k = np.arange(SKY_LOBES) + 0.5
    y, azimuth = 1 - 2 * k / SKY_LOBES, k * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - y**2)
    return np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], axis=1)


def _lobes(directions: Floats) -> Floats:
    """Sky lobes [K, SKY_LOBES] at ``directions`` [K, 3]."""
    return np.exp(SKY_SHARPNESS * (directions @ _lobe_centres().T - 1))


def _texels_near(directions: Floats, centres: Floats) -> NDArray[np.int64]:
    """Indices of the texels within 1.5 search texels of any of ``centres`` [C, 3]."""
    if len(centres) == 0:
        return np.empty(0, np.int64)
    reach = 1.5 * math.pi / SEARCH_SHAPE[0]
    return np.nonzero((directions @ centres.T).max(1) > math.cos(reach))[0]
