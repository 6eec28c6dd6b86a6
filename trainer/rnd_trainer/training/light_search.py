"""A first light from the first stage's geometry: a smooth sky and a few suns, by linear least squares.

A person who turns in front of the camera is a light probe: the same points are seen with their normals towards
many directions. Gradient descent from a white probe never grows a sun (its texel must rise a thousandfold while
the albedo explains the shadows away); here the sun is *searched* for. The pictures are

    I_pf = albedo_p Σ_k L_k V_pfk max(n_pf · ω_k, 0) Δω_k / π        (paper, eq. 3, without the specular lobe)

and the albedo drops out: whatever it is, a point's colours over the pictures run parallel to its irradiance. So
a dictionary of broad lobes (the sky) and single directions (suns, with traced shadows) is fitted by non-negative
least squares, and a direction joins where it explains most of what is left (orthogonal matching pursuit, Pati et
al. 1993).

Squares find where the suns are, but not how strong: a shadow's edge in the wrong place, or a fold that the shape
does not have, looks like a brighter sky, and what errs in proportion to its light counts most where that is
strong. The strengths are therefore found by least absolute error of the colours' logarithms (iteratively
reweighted: Holland & Welsch 1977).
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

from .data import TrainingView

Floats = NDArray[np.float64]

SEARCH_SHAPE = (16, 32)
"""texels in which suns are searched, 11° wide; what is found is then refined in the probe's own texels"""
SKY_LOBES = 32
"""spherical Gaussians that carry the sky"""
SKY_SHARPNESS = 4.0
"""λ of exp(λ(cos − 1)): lobes 24° wide, which overlap into a smooth map"""
SKY_FLOOR = 0.02
"""of the mean radiance: no texel of a logarithmic probe may start black"""
MAX_SUNS = 3
"""bright directions at most"""
MIN_GAIN = 0.01
"""of the squared error that is left: what explains less is not a sun"""
NOISE_FLOOR = 2e-3
"""of the energy: an error below it needs no sun (that of real captures is ten times as large)"""
CANDIDATES = 24
"""directions that are tried in earnest before one is chosen: both ends of an axis, and their neighbours"""
ROUND_OFF = 1e-5
"""share of all irradiance below which what no light explains is float32's rounding"""
RIDGE = 1e-4
"""relative, on the normal equations: neighbouring lobes are nearly the same column"""
REWEIGHTINGS = 10
"""after which the strengths no longer move"""
ERROR_FLOOR = 0.1
"""relative error of a colour below which it counts no more for being smaller"""
SKY_PRIOR = 1.0
"""relative weight of a natural sky: what no picture tells of, behind the person, is like the rest"""
PENALTY = 30.0
"""of the constraint that fixes the light's scale, relative to the error: large enough to hold it"""
POINTS = 3_000
"""of the nodes, whose every prefix covers the body"""
FRAMES = 40
"""pictures that are looked at, spread evenly over the capture"""
FACING = 0.3
"""cosine between normal and view below which a point's colour is not trusted"""
MIN_SIGHTINGS = 3
"""of a point before it has a say in where suns are: a sun that shines only on what is seen once or twice, its albedo
unknown, contradicts nothing, and the search would give it all the light"""
OCCLUSION = 0.03
"""metres by which a point may lie behind the first surface and still be the one that is seen"""
REFLECTANCE = 0.22
"""share of the light that people give back, on average: a photographer's grey card, 18 %, and 4 % at the surface"""


@dataclass
class FirstLight:
    """A light to start from: radiance [32, 64, 3], and exposure [32, 64].

    exposure: what unit radiance from each texel adds to what the pictures show of a white body, on average.
    """

    radiance: NDArray[np.float32]
    exposure: NDArray[np.float32]


@dataclass
class Sightings:
    """n sightings of body points: who [n], linear colour [n, 3], posed points and normals of each picture."""

    who: NDArray[np.int64]
    colour: Floats
    picture: NDArray[np.int64]
    posed: list[tuple[torch.Tensor, torch.Tensor]]
    spacing: float


def start_light(
    model: AvatarModel,
    views: Sequence[TrainingView],
    poses: Sequence[PoseInput],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> FirstLight | None:
    """The light that best explains the images; None where the body is hardly seen, or always from one side.

    Its scale makes the visible body reflect ``REFLECTANCE`` of the incident light.

    Args:
        model: with the geometry of the first stage.
        views, poses: of the training images, in the same order.
        on_progress: called with done and total.
    """
    parts = iter(range(1, 6))

    def advance() -> None:
        on_progress(next(parts), 5)

    on_progress(0, 5)
    seen = _sightings(model, views, poses)
    advance()
    if len(seen.who) == 0:
        return None
    often = np.bincount(seen.who)[seen.who] >= MIN_SIGHTINGS
    if np.count_nonzero(often) < 10 * SKY_LOBES:
        return None
    weight = _by_brightness(seen) * often
    directions, solid_angles = _grid(PROBE_SHAPE)
    wide, wide_angles = _grid(SEARCH_SHAPE)
    coarse = _transport(seen, wide, wide_angles)
    sky = coarse @ _lobes(wide).astype(np.float32)
    everything = _quadratic(seen, np.concatenate([sky, coarse], axis=1), weight)
    advance()
    if everything.is_undetermined():
        return None
    found = _search(everything)
    advance()
    near = _texels_near(directions, wide[np.array(found, int) - SKY_LOBES])
    fine = _transport(seen, directions[near], solid_angles[near])
    columns = np.concatenate([sky, fine], axis=1)
    suns = _search(_quadratic(seen, columns, weight))
    advance()
    strength = _strengths(seen, columns[:, [*range(SKY_LOBES), *suns]])
    advance()
    radiance = _lobes(directions) @ strength[:SKY_LOBES]
    radiance = np.maximum(radiance, SKY_FLOOR * radiance.mean())
    radiance[near[np.array(suns, int) - SKY_LOBES]] += strength[SKY_LOBES:]
    exposure = _spread(coarse.mean(0) / wide_angles) * solid_angles
    level = (seen.colour @ REC709_LUMINANCE).mean() / REFLECTANCE
    radiance *= level / ((radiance @ REC709_LUMINANCE) @ exposure)
    return FirstLight(
        radiance.reshape(*PROBE_SHAPE, 3).astype(np.float32), exposure.reshape(PROBE_SHAPE).astype(np.float32)
    )


def warm_up() -> None:
    """Fit a sky to random data, so that linear algebra allocates its buffers."""
    draw = np.random.default_rng(0)
    transport = draw.random((8 * POINTS, SKY_LOBES + math.prod(SEARCH_SHAPE)), dtype=np.float32)
    colour, who = 0.1 + draw.random((len(transport), 3)), np.arange(len(transport)) % POINTS
    seen = Sightings(who, colour, np.zeros(len(who), np.int64), [], 0.0)
    _quadratic(seen, transport, _by_brightness(seen)).fit(range(SKY_LOBES))


def _sightings(model: AvatarModel, views: Sequence[TrainingView], poses: Sequence[PoseInput]) -> Sightings:
    """Colours of the first nodes wherever they are seen well: inside the mask, in front, not clipped."""
    nodes = min(POINTS, model.config.nodes)
    spacing = float(model.spacing) * math.sqrt(len(model.points) / nodes)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(FRAMES, len(views))).astype(int))
    who, colour, picture, posed_nodes = [], [], [], []
    for k, index in enumerate(chosen):
        view, camera = views[index], views[index].camera
        with torch.no_grad():
            posed = model(poses[index])
        visible, pixel = in_sight(posed, camera, nodes, facing=FACING, occlusion=OCCLUSION)
        column, row = pixel.astype(int).T
        pixels = view.image[row, column]
        unclipped = (view.mask[row, column] == 255) & (pixels.max(1) < 250)
        good = np.nonzero(visible & unclipped)[0]
        who.append(good)
        colour.append(srgb_to_linear(pixels[good] / 255))
        picture.append(np.full(len(good), k))
        posed_nodes.append((posed.means[:nodes].cpu(), posed.normals[:nodes].cpu()))
    return Sightings(np.concatenate(who), np.concatenate(colour), np.concatenate(picture), posed_nodes, spacing)


def _transport(seen: Sightings, directions: Floats, solid_angles: Floats) -> NDArray[np.float32]:
    """[n, K]: what unit radiance from each direction adds to a white sighting, shadows traced."""
    towards = torch.as_tensor(directions, dtype=torch.float32)
    rows = []
    for k, (means, normals) in enumerate(seen.posed):
        who = seen.who[seen.picture == k]
        visible = traced_visibility(means, normals, towards, seen.spacing)[who]
        rows.append((visible * (normals[who] @ towards.T).clamp(min=0)).numpy())
    return np.concatenate(rows) * (solid_angles / np.pi).astype(np.float32)


@dataclass
class Quadratic:
    """‖what a light leaves unexplained‖² = Lᵀ disagreement L for each channel, and the light that is seen, seen · L.

    disagreement [3, Q, Q]; power [Q, Q], whose form is ‖all irradiance‖²; seen [Q]; Q columns of the dictionary.
    """

    disagreement: Floats
    power: Floats
    seen: Floats

    def is_undetermined(self) -> bool:
        """Whether any light would do: no point is seen twice, or always alike."""
        unexplained = float(np.trace(self.disagreement.mean(0)))
        return unexplained < ROUND_OFF * float(np.trace(self.power))

    def fit(self, columns: Sequence[int]) -> tuple[float, Floats]:
        """Least error over non-negative strengths [len(columns), 3] whose light is seen as 1, and the strengths."""
        pick = np.asarray(columns)
        weight = PENALTY * math.sqrt(float(np.trace(self.disagreement.mean(0)))) / np.linalg.norm(self.seen)
        strength, error = np.empty((len(pick), 3)), 0.0
        for channel in range(3):
            gram = self.disagreement[channel][np.ix_(pick, pick)]
            gram = gram + np.diag(RIDGE * np.diag(gram) + 1e-12)
            sky = slice(0, SKY_LOBES)  # the dictionary's first columns, always picked
            level = SKY_PRIOR * float(np.diag(gram)[sky].mean())
            expected = natural_sky(_lobe_centres()[:, 1])
            gram[sky, sky] += level * (np.eye(SKY_LOBES) - np.outer(expected, expected) / (expected @ expected))
            factor = np.linalg.cholesky(gram).T  # ‖factor L‖² is the error, in as many rows as columns
            rows = np.concatenate([factor, weight * self.seen[None, pick]])
            wanted = np.append(np.zeros(len(pick)), weight)
            strength[:, channel], _ = nnls(rows, wanted)
            strength[:, channel] /= self.seen[pick] @ strength[:, channel]
            error += float(strength[:, channel] @ self.disagreement[channel][np.ix_(pick, pick)] @ strength[:, channel])
        return error, strength

    def gains(self, columns: Sequence[int], strength: Floats) -> Floats:
        """[Q] how fast the error falls when light is moved into each column, in the column's own measure."""
        pick = np.asarray(columns)
        gain = np.zeros(len(self.seen))
        for channel in range(3):
            matrix = self.disagreement[channel]
            pull = matrix[:, pick] @ strength[:, channel]
            level = strength[:, channel] @ pull[pick]  # Lagrange's multiplier of seen · L = 1
            gain += (level * self.seen - pull) / np.sqrt(np.diag(matrix) + 1e-12)
        return gain


def _by_brightness(seen: Sightings) -> Floats:
    """Weights [n] that are each point's mean luminance: an error of a dark point is a small one."""
    count = np.maximum(np.bincount(seen.who), 1)
    return (np.bincount(seen.who, seen.colour @ REC709_LUMINANCE) / count)[seen.who]


def _quadratic(seen: Sightings, transport: NDArray[np.float32], weight: Floats) -> Quadratic:
    """The quadratic form of ``transport`` [n, Q]: a point's irradiance must run parallel to its colours.

    With I_p the colours and T_p L the irradiance of point p in its pictures, the best albedo leaves
    ‖(1 − Î_p Î_pᵀ) T_p L‖: no albedo is left to solve for. Sightings count by ``weight`` [n].
    """
    count, columns = int(seen.who.max()) + 1, transport.shape[1]
    root = np.sqrt(weight)
    rows = transport * root[:, None].astype(transport.dtype)
    whole = (rows.T @ rows).astype(np.float64)
    order = np.argsort(seen.who, kind="stable")
    starts = np.flatnonzero(np.diff(seen.who[order], prepend=-1))
    disagreement = np.empty((3, columns, columns))
    for channel in range(3):
        colour = seen.colour[:, channel] * root
        length = np.sqrt(np.bincount(seen.who, colour**2, count))
        unit = (colour / np.maximum(length[seen.who], 1e-9)).astype(rows.dtype)
        along = np.add.reduceat((rows * unit[:, None])[order], starts, axis=0).astype(np.float64)
        disagreement[channel] = whole - along.T @ along
    return Quadratic(disagreement, whole, rows.sum(0, dtype=np.float64))


def _strengths(seen: Sightings, columns: NDArray[np.float32]) -> Floats:
    """Strengths [Q, 3] of the sky's lobes and the suns that leave the least absolute error of log colours."""
    everything = list(range(columns.shape[1]))
    _, strength = _quadratic(seen, columns, _by_brightness(seen)).fit(everything)
    colour = np.log(np.maximum(seen.colour @ REC709_LUMINANCE, 1e-4))
    count, weight = int(seen.who.max()) + 1, np.ones(len(colour))
    for _ in range(REWEIGHTINGS):
        light = columns @ (strength @ REC709_LUMINANCE)
        light = np.maximum(light / light.mean(), 1e-3)
        total = np.bincount(seen.who, weight * (colour - np.log(light)), count)
        albedo = total / np.maximum(np.bincount(seen.who, weight, count), 1e-12)
        error = np.abs(colour - np.log(light) - albedo[seen.who])
        weight = 1 / np.maximum(error, ERROR_FLOOR)
        _, strength = _quadratic(seen, columns, weight / light**2).fit(everything)
    return strength


def _search(form: Quadratic) -> list[int]:
    """Columns after the sky's that are suns, strongest first: added while they explain enough.

    A direction and its opposite promise alike where nothing casts a shadow, since above degree 1 a cosine lobe
    has even harmonics only (Ramamoorthi & Hanrahan 2001); so the best few are tried in earnest.
    """
    columns = list(range(SKY_LOBES))
    before, strength = form.fit(columns)
    sky = slice(0, SKY_LOBES)
    least = NOISE_FLOOR * float(np.einsum("qc,qr,rc", strength, form.power[sky, sky], strength))
    while len(columns) < min(SKY_LOBES + MAX_SUNS, len(form.seen)) and before > least:
        gain = form.gains(columns, strength)
        gain[columns] = -np.inf
        tried = [(form.fit([*columns, int(k)])[0], int(k)) for k in np.argsort(-gain)[:CANDIDATES]]
        after, best = min(tried)
        if before - after < MIN_GAIN * before:
            break
        columns.append(best)
        before, strength = form.fit(columns)
    return columns[SKY_LOBES:]


def _grid(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    return texel_directions(*shape).reshape(-1, 3), texel_solid_angles(*shape).reshape(-1)


def _spread(coarse: Floats) -> Floats:
    """A map in the search's texels [K], repeated in the probe's."""
    rows, columns = (fine // wide for fine, wide in zip(PROBE_SHAPE, SEARCH_SHAPE, strict=True))
    return coarse.reshape(SEARCH_SHAPE).repeat(rows, 0).repeat(columns, 1).reshape(-1)


def _lobe_centres() -> Floats:
    """Unit directions [SKY_LOBES, 3] of a Fibonacci lattice."""
    k = np.arange(SKY_LOBES) + 0.5
    y, azimuth = 1 - 2 * k / SKY_LOBES, k * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - y**2)
    return np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], axis=1)


def _lobes(directions: Floats) -> Floats:
    """The sky's dictionary [K, SKY_LOBES] at ``directions`` [K, 3]."""
    return np.exp(SKY_SHARPNESS * (directions @ _lobe_centres().T - 1))


def _texels_near(directions: Floats, centres: Floats) -> NDArray[np.int64]:
    """Texels within one and a half search texels of any of the centres."""
    if len(centres) == 0:
        return np.empty(0, np.int64)
    reach = 1.5 * math.pi / SEARCH_SHAPE[0]
    return np.nonzero((directions @ centres.T).max(1) > math.cos(reach))[0]
