"""The first light: a sun that is there is found, one that is not is not invented."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rnd_runtime.shading.light import texel_directions, texel_solid_angles
from rnd_trainer.training import light_search
from rnd_trainer.training.light_search import Sightings, start_light

COUNT, PICTURES = 700, 24
WITHIN = math.cos(math.radians(6))  # a probe texel is 5.6° wide
ENERGY = 0.25  # of the sun's share of the light, relative: the albedo is unknown and may take some of it
ROBUST = 0.15  # the same where the colours err too
SHADOWS = 0.05  # the ball's own, as they are traced: those of 700 splats are a little too wide


def _turning_ball(sun: np.ndarray, strength: float) -> Sightings:
    """A ball of random albedo that turns about Y under a white sky and one sun, seen from +Z."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=generator), dim=-1)
    albedo = 0.2 + 0.5 * torch.rand(COUNT, 3, generator=generator)
    who, colour, picture, posed = [], [], [], []
    for k in range(PICTURES):
        angle = 2 * math.pi * k / PICTURES
        turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        normals = points @ turn.T
        seen = (normals[:, 2] > light_search.FACING).nonzero()[:, 0]
        arriving = 1 + strength / math.pi * (normals[seen] @ torch.as_tensor(sun).float()).clamp(min=0)
        who.append(seen.numpy())
        colour.append((albedo[seen] * arriving[:, None]).double().numpy())
        picture.append(np.full(len(seen), k))
        posed.append((normals, normals))
    return Sightings(*(np.concatenate(x) for x in (who, colour, picture)), posed, 0.1)


@pytest.mark.parametrize("strength", [0.0, 6.0])
def test_a_sun_is_found_where_there_is_one(monkeypatch, strength) -> None:
    sun = np.array([0.7, 0.5, 0.51])
    sun /= np.linalg.norm(sun)
    ball = _turning_ball(sun, strength)
    monkeypatch.setattr(light_search, "_sightings", lambda *_: ball)
    found = start_light(None, [], [])  # type: ignore[arg-type]  # the sightings are given
    assert found is not None
    light, exposure = found.radiance, found.exposure
    assert light.shape == (32, 64, 3) and (light > 0).all() and (exposure >= 0).all()
    solid_angles = texel_solid_angles(32, 64)
    grey = light.mean(-1)
    normals = np.concatenate([n[ball.who[ball.picture == k]] for k, (_, n) in enumerate(ball.posed)])
    cosines = np.maximum(normals @ texel_directions(32, 64).reshape(-1, 3).T, 0)
    arriving = (cosines @ (grey * solid_angles).reshape(-1) / math.pi).mean()
    assert ball.colour.mean() / arriving == pytest.approx(light_search.REFLECTANCE, rel=SHADOWS)
    assert (grey * exposure).sum() == pytest.approx(arriving, rel=SHADOWS)
    near = texel_directions(32, 64) @ sun > math.cos(math.radians(12))
    share = (grey * solid_angles)[near].sum() / (grey * solid_angles).sum()
    if strength:
        brightest = texel_directions(32, 64).reshape(-1, 3)[grey.argmax()]
        assert brightest @ sun > WITHIN
        assert share == pytest.approx(strength / (strength + 4 * math.pi), rel=ENERGY)
    else:
        assert grey.max() < 2 * grey.mean()  # a white sky stays one


def test_the_sun_keeps_its_strength_under_texture_and_wrong_shadows(monkeypatch) -> None:
    """Colours off by 30 %, as of texture seen a little beside its point; a quarter of the shade twice as bright.

    Least squares alone would leave the sun 23 % too weak.
    """
    sun = np.array([0.7, 0.5, 0.51]) / np.linalg.norm([0.7, 0.5, 0.51])
    ball = _turning_ball(sun, 6.0)
    normals = np.concatenate([n[ball.who[ball.picture == k]] for k, (_, n) in enumerate(ball.posed)])
    shade = np.flatnonzero(normals @ sun < 0)
    draw = np.random.default_rng(0)
    ball.colour *= np.exp(0.3 * draw.normal(size=(len(ball.colour), 1)))
    ball.colour[shade[draw.random(len(shade)) < 1 / 4]] *= 2
    monkeypatch.setattr(light_search, "_sightings", lambda *_: ball)
    found = start_light(None, [], [])  # type: ignore[arg-type]
    assert found is not None
    energy = found.radiance.mean(-1) * texel_solid_angles(32, 64)
    near = texel_directions(32, 64) @ sun > math.cos(math.radians(12))
    assert energy[near].sum() / energy.sum() == pytest.approx(6 / (6 + 4 * math.pi), rel=ROBUST)


def test_pictures_that_are_all_alike_give_none(monkeypatch) -> None:
    """Any light explains them: each point's irradiance is parallel to its colours whatever it is."""
    ball = _turning_ball(np.array([0.0, 1.0, 0.0]), 6.0)
    first = ball.picture == 0
    count = int(first.sum())
    alike = Sightings(
        np.tile(ball.who[first], 3),
        np.tile(ball.colour[first], (3, 1)),
        np.repeat([0, 1, 2], count),
        [ball.posed[0]] * 3,
        ball.spacing,
    )
    once = Sightings(ball.who[first], ball.colour[first], ball.picture[first], ball.posed[:1], ball.spacing)
    for seen in (alike, once):
        monkeypatch.setattr(light_search, "_sightings", lambda *_, seen=seen: seen)
        assert start_light(None, [], []) is None  # type: ignore[arg-type]


def test_too_few_sightings_give_none(monkeypatch) -> None:
    ball = _turning_ball(np.array([0.0, 1.0, 0.0]), 0.0)
    few = Sightings(ball.who[:20], ball.colour[:20], ball.picture[:20], ball.posed, 0.1)
    monkeypatch.setattr(light_search, "_sightings", lambda *_: few)
    assert start_light(None, [], []) is None  # type: ignore[arg-type]


def test_what_is_seen_once_or_twice_invents_no_sun(monkeypatch) -> None:
    """Three pictures from three sides: each point is in one or two of them, and its albedo could explain any sun."""
    ball = _turning_ball(np.array([0.7, 0.5, 0.51]), 6.0)
    few = np.isin(ball.picture, (0, 8, 16))
    seen = Sightings(ball.who[few], ball.colour[few], ball.picture[few] // 8, ball.posed[::8], ball.spacing)
    monkeypatch.setattr(light_search, "_sightings", lambda *_: seen)
    assert start_light(None, [], []) is None  # type: ignore[arg-type]
