"""Light that the ground reflects: energy, the shadow's mean, and Mitsuba."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_bench.ground.judge import GROUND, body_surface, lights, played_bounce, posed_body, traced_bounce
from rnd_runtime.ground.bounce import light_over, mean_share
from rnd_runtime.ground.shadow import GroundLight
from rnd_runtime.ground.standing import UP
from rnd_runtime.shading.light import Light
from support.shading_scenes import probe
from support.tiny import body

ALBEDO = np.array([0.6, 0.3, 0.1])


def test_the_lower_half_has_the_grounds_radiance():
    white = Light(np.ones((64, 128, 3), np.float32))
    lit = light_over(white, UP, ALBEDO)
    np.testing.assert_array_equal(lit.radiance[:31], 1)
    np.testing.assert_allclose(lit.radiance[33:], np.broadcast_to(ALBEDO, (31, 128, 3)), rtol=1e-3)


@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_it_turns_with_the_light(up):
    light = probe(up=up)
    one = light_over(light, UP, ALBEDO).with_yaw(1.3)
    other = light_over(light.with_yaw(1.3), UP, ALBEDO)
    np.testing.assert_allclose(one.radiance, other.radiance, rtol=1e-5)
    down = one.sample([[0.3, -0.6, 0.1], [-0.4, -0.2, 0.5]])
    np.testing.assert_allclose(down[0], down[1], rtol=1e-5)
    np.testing.assert_allclose(one.sample([0.3, 0.6, 0.1]), light.with_yaw(1.3).sample([0.3, 0.6, 0.1]))


def test_the_bodys_shadow_takes_some_of_it():
    gaussians, radii = body_surface(*posed_body(body(), 0.0))
    np.testing.assert_array_equal(mean_share(gaussians, None), 1)
    shadow = GroundLight(probe()).shadow(gaussians, radii, GROUND, np.eye(3))
    share = mean_share(gaussians, shadow)
    assert (share > 0.6).all() and (share < 0.97).all()
    lifted = mean_share(
        gaussians, GroundLight(probe()).shadow(gaussians, radii, GROUND._replace(offset=-2.0), np.eye(3))
    )
    assert (lifted > share).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sky", "sun and sky"])
def test_it_agrees_with_mitsuba(kind):
    pytest.importorskip("mitsuba")
    light, bare = lights()[kind], posed_body(body(), 0.0)
    theirs = traced_bounce(light, *bare, 0.5, 64)
    inside = theirs[..., 3] > 0.99
    ratio = played_bounce(light, *bare, 0.5)[inside].mean() / theirs[inside][:, :3].mean()
    assert 0.94 < ratio < 1.06
