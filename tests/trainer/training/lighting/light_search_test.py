"""The light search finds a directional light that is there, and adds none that is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rnd_runtime.shading.light import texel_directions, texel_solid_angles
from rnd_trainer.training.lighting import light_search, skin
from rnd_trainer.training.lighting.light_search import initial_light
from rnd_trainer.training.lighting.observations import FACING, Observations

COUNT, IMAGES = 700, 24
WITHIN = math.cos(math.radians(6))  # a probe texel is 5.6° wide
ENERGY = 0.25  # of the sun's share of the light, relative: the albedo is unknown and may take some of it
ROBUST = 0.15  # the same where the colours err too
SHADOWS = 0.07  # the ball's own shadows: those of 700 splats are too wide, and what they hide is taken to reflect


def rotating_ball(sun: np.ndarray, strength: float, count: int = COUNT, images: int = IMAGES) -> Observations:
    """A ball of random albedo rotating about Y under a white sky and one sun, seen from +Z."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    albedo = 0.2 + 0.5 * torch.rand(count, 3, generator=generator)
    point, colour, image, posed = [], [], [], []
    for k in range(images):
        angle = 2 * math.pi * k / images
        rotation = torch.tensor(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
        )
        normals = points @ rotation.T
        seen = (normals[:, 2] > FACING).nonzero()[:, 0]
        arriving = 1 + strength / math.pi * (normals[seen] @ torch.as_tensor(sun).float()).clamp(min=0)
        point.append(seen.numpy())
        colour.append((albedo[seen] * arriving[:, None]).double().numpy())
        image.append(np.full(len(seen), k))
        posed.append((normals, normals))
    return Observations(*(np.concatenate(x) for x in (point, colour, image)), posed, 0.1)


def _arriving(ball: Observations, sun: np.ndarray) -> np.ndarray:
    """Irradiance over π of each observation [n] under the sky and a sun of strength 6."""
    normals = np.concatenate([n[ball.point[ball.image == k]] for k, (_, n) in enumerate(ball.posed)])
    return 1 + 6 / math.pi * np.maximum(normals @ sun, 0)


def _peaks(monkeypatch, ball: Observations, least: str) -> list[float]:
    """Largest over mean radiance of the light found, without the bound ``least`` and with it."""
    monkeypatch.setattr(light_search, "observe", lambda *_: ball)
    peaks = []
    for bound in (0.0, getattr(light_search, least)):
        monkeypatch.setattr(light_search, least, bound)
        found = initial_light(None, [], [])  # type: ignore[arg-type]  # the observations are given
        assert found is not None
        peaks.append(found.radiance.max() / found.radiance.mean())
    return peaks


@pytest.mark.parametrize("strength", [0.0, 6.0])
def test_a_sun_is_found_where_there_is_one(monkeypatch, strength) -> None:
    sun = np.array([0.7, 0.5, 0.51])
    sun /= np.linalg.norm(sun)
    ball = rotating_ball(sun, strength)
    monkeypatch.setattr(light_search, "observe", lambda *_: ball)
    found = initial_light(None, [], [])  # type: ignore[arg-type]  # the observations are given
    assert found is not None
    light, exposure = found.radiance[0], found.exposure[0]
    assert light.shape == (32, 64, 3) and (light > 0).all() and (exposure >= 0).all()
    solid_angles = texel_solid_angles(32, 64)
    grey = light.mean(-1)
    normals = np.concatenate([n[ball.point[ball.image == k]] for k, (_, n) in enumerate(ball.posed)])
    cosines = np.maximum(normals @ texel_directions(32, 64).reshape(-1, 3).T, 0)
    arriving = (cosines @ (grey * solid_angles).reshape(-1) / math.pi).mean()
    assert ball.colour.mean() / arriving == pytest.approx(skin.BODY_LUMINANCE, rel=SHADOWS)
    assert (grey * exposure).sum() == pytest.approx(arriving, rel=SHADOWS)
    near = texel_directions(32, 64) @ sun > math.cos(math.radians(12))
    share = (grey * solid_angles)[near].sum() / (grey * solid_angles).sum()
    if strength:
        brightest = texel_directions(32, 64).reshape(-1, 3)[grey.argmax()]
        assert brightest @ sun > WITHIN
        assert share == pytest.approx(strength / (strength + 4 * math.pi), rel=ENERGY)
    else:
        assert grey.max() < 2 * grey.mean()  # a white sky stays one


def test_a_first_sun_must_explain_more_than_errors_do(monkeypatch) -> None:
    """On a real video errors of body and poses are explained a little by a sun that is not there."""
    sun = np.array([0.7, 0.5, 0.51]) / np.linalg.norm([0.7, 0.5, 0.51])
    ball = rotating_ball(sun, 1.0)
    ball.colour *= np.exp(0.15 * np.random.default_rng(0).normal(size=(len(ball.colour), 1)))
    without, with_it = _peaks(monkeypatch, ball, "FIRST_GAIN")
    assert without > 30 and with_it < 4


def test_a_window_is_found_as_broad_as_it_is(monkeypatch) -> None:
    """On a ball, which has no shadows to tell by, the lesser error decides."""
    monkeypatch.setattr(light_search, "BROADER", 1.0)
    towards = np.array([0.7, 0.3, 0.65]) / np.linalg.norm([0.7, 0.3, 0.65])
    directions, solid_angles = texel_directions(32, 64).reshape(-1, 3), texel_solid_angles(32, 64).reshape(-1)
    true = 1 + 60 * np.exp(light_search.WINDOW_SHARPNESS * (directions @ towards - 1))
    ball = rotating_ball(towards, 0.0)
    normals = np.concatenate([n[ball.point[ball.image == k]] for k, (_, n) in enumerate(ball.posed)])
    share = np.maximum(normals @ directions.T, 0) * solid_angles / math.pi
    ball.colour *= (share @ true)[:, None]
    monkeypatch.setattr(light_search, "observe", lambda *_: ball)
    found = initial_light(None, [], [])  # type: ignore[arg-type]
    assert found is not None
    grey = found.radiance[0].mean(-1).reshape(-1)
    assert directions[grey.argmax()] @ towards > math.cos(math.radians(12))  # a texel of the coarse search
    assert 0.5 < grey.max() / np.median(grey) / (true.max() / np.median(true)) < 2  # a sun's is 20 times as much


def test_no_sun_is_below_the_floor(monkeypatch) -> None:
    """Light from below is the ground's: broad."""
    sun = np.array([0.5, -0.7, 0.51])
    ball = rotating_ball(sun / np.linalg.norm(sun), 6.0)
    monkeypatch.setattr(light_search, "observe", lambda *_: ball)
    found = initial_light(None, [], [])  # type: ignore[arg-type]  # the observations are given
    assert found is not None
    below = found.radiance[0][16:].mean(axis=2)
    assert below.max() < 4 * below.mean()


def test_no_sun_is_where_it_hardly_reaches_what_is_seen(monkeypatch) -> None:
    """From behind a ball it touches a rim alone, which errors of outlines can explain as well at any strength."""
    sun = np.array([0.0, 0.5, -0.866])
    without, with_it = _peaks(monkeypatch, rotating_ball(sun, 60.0), "MIN_REACH")
    assert without > 100 and with_it < 4


def test_the_sun_keeps_its_strength_under_texture_and_wrong_shadows(monkeypatch) -> None:
    """Noise of 30 % on colours, a quarter of the shade twice as bright; least squares alone lose 23 % of the sun."""
    sun = np.array([0.7, 0.5, 0.51]) / np.linalg.norm([0.7, 0.5, 0.51])
    ball = rotating_ball(sun, 6.0)
    normals = np.concatenate([n[ball.point[ball.image == k]] for k, (_, n) in enumerate(ball.posed)])
    shade = np.flatnonzero(normals @ sun < 0)
    rng = np.random.default_rng(0)
    ball.colour *= np.exp(0.3 * rng.normal(size=(len(ball.colour), 1)))
    ball.colour[shade[rng.random(len(shade)) < 1 / 4]] *= 2
    monkeypatch.setattr(light_search, "observe", lambda *_: ball)
    found = initial_light(None, [], [])  # type: ignore[arg-type]
    assert found is not None
    energy = found.radiance[0].mean(-1) * texel_solid_angles(32, 64)
    near = texel_directions(32, 64) @ sun > math.cos(math.radians(12))
    assert energy[near].sum() / energy.sum() == pytest.approx(6 / (6 + 4 * math.pi), rel=ROBUST)


def test_two_lights_are_found_with_their_ratio(monkeypatch) -> None:
    """Noon is twice as bright as evening, which is redder; the albedo tells, as it is the same in both."""
    noon, evening = (np.array(sun) / np.linalg.norm(sun) for sun in ([0.7, 0.5, 0.51], [-0.6, 0.3, 0.74]))
    balls = [rotating_ball(sun, 6.0, count=400, images=16) for sun in (noon, evening)]
    factors = np.array([[2.0, 2.0, 2.0], [1.4, 1.0, 0.7]])
    both = Observations(
        np.concatenate([ball.point for ball in balls]),
        np.concatenate([ball.colour * factor for ball, factor in zip(balls, factors, strict=True)]),
        np.concatenate([balls[0].image, balls[1].image + 16]),
        [*balls[0].posed, *balls[1].posed],
        0.1,
        [0] * 16 + [1] * 16,
    )
    monkeypatch.setattr(light_search, "observe", lambda *_: both)
    found = initial_light(None, [], [])  # type: ignore[arg-type]
    assert found is not None
    for radiance, sun in zip(found.radiance, (noon, evening), strict=True):
        brightest = texel_directions(32, 64).reshape(-1, 3)[radiance.mean(-1).argmax()]
        assert brightest @ sun > WITHIN
    reached = np.einsum("lhwc,lhw->lc", found.radiance, found.exposure)
    true = factors * [[_arriving(ball, sun).mean()] for ball, sun in zip(balls, (noon, evening), strict=True)]
    assert reached[0] / reached[1] == pytest.approx(true[0] / true[1], rel=SHADOWS)


def test_equal_images_give_none(monkeypatch) -> None:
    """Any light explains equal images: each point's irradiance is parallel to its colours."""
    ball = rotating_ball(np.array([0.0, 1.0, 0.0]), 6.0)
    first = ball.image == 0
    count = int(first.sum())
    alike = Observations(
        np.tile(ball.point[first], 3),
        np.tile(ball.colour[first], (3, 1)),
        np.repeat([0, 1, 2], count),
        [ball.posed[0]] * 3,
        ball.spacing,
    )
    once = Observations(ball.point[first], ball.colour[first], ball.image[first], ball.posed[:1], ball.spacing)
    for seen in (alike, once):
        monkeypatch.setattr(light_search, "observe", lambda *_, seen=seen: seen)
        assert initial_light(None, [], []) is None  # type: ignore[arg-type]


def test_too_few_observations_give_none(monkeypatch) -> None:
    ball = rotating_ball(np.array([0.0, 1.0, 0.0]), 0.0)
    few = Observations(ball.point[:20], ball.colour[:20], ball.image[:20], ball.posed, 0.1)
    monkeypatch.setattr(light_search, "observe", lambda *_: few)
    assert initial_light(None, [], []) is None  # type: ignore[arg-type]


def test_points_observed_once_or_twice_give_no_sun(monkeypatch) -> None:
    """In three images from three sides each point is observed once or twice; its albedo explains any sun."""
    ball = rotating_ball(np.array([0.7, 0.5, 0.51]), 6.0)
    few = np.isin(ball.image, (0, 8, 16))
    seen = Observations(ball.point[few], ball.colour[few], ball.image[few] // 8, ball.posed[::8], ball.spacing)
    monkeypatch.setattr(light_search, "observe", lambda *_: seen)
    assert initial_light(None, [], []) is None  # type: ignore[arg-type]
