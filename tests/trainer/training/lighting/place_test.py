"""A known light is turned to the images and scaled by the body's reflectance."""

from __future__ import annotations

import math

import numpy as np

from rnd_runtime.shading.light import Light, texel_directions, texel_solid_angles
from rnd_trainer.training.lighting import place, skin
from trainer.training.lighting.light_search_test import SHADOWS, rotating_ball

STRENGTH = 6.0
WITHIN_DEG = 2.0


def test_a_place_turned_and_scaled_is_found(monkeypatch) -> None:
    """To 2° of yaw; its level is that of a body of mean reflectance, whatever the file's exposure."""
    sun = np.array([0.7, 0.5, 0.51]) / np.linalg.norm([0.7, 0.5, 0.51])
    ball = rotating_ball(sun, STRENGTH, count=300, images=10)
    ball.colour *= [1.2, 1.0, 0.7]
    ball.colour += 0.2 * ball.colour.mean(0)  # by reflections between limbs
    monkeypatch.setattr(place, "observe", lambda *_: ball)
    map_ = np.ones((128, 256, 3), np.float32)
    row, column = np.unravel_index((texel_directions(128, 256) @ sun).argmax(), (128, 256))
    map_[row, (column + 71) % 256] += STRENGTH / texel_solid_angles(128, 256)[row, column]
    file = Light(3.7 * map_ * np.float32([1.2, 1.0, 0.7]))
    found = place.placed_light(None, [], [], file)  # type: ignore[arg-type]  # the observations are given
    assert found is not None and found.shape == (32, 64, 3)
    energy = found.mean(-1) * texel_solid_angles(32, 64)
    near = energy * (texel_directions(32, 64) @ sun > math.cos(math.radians(15)))
    centre = (near[..., None] * texel_directions(32, 64)).sum((0, 1))
    turned = math.degrees(math.atan2(centre[2], centre[0]) - math.atan2(sun[2], sun[0]))
    assert abs(turned) < WITHIN_DEG
    normals = np.concatenate([n[ball.point[ball.image == k]] for k, (_, n) in enumerate(ball.posed)])
    cosines = np.maximum(normals @ texel_directions(32, 64).reshape(-1, 3).T, 0)
    arriving = cosines @ (found * texel_solid_angles(32, 64)[..., None]).reshape(-1, 3) / math.pi
    assert np.allclose(ball.colour.mean(0) / arriving.mean(0), skin.BODY_LUMINANCE, rtol=SHADOWS)
