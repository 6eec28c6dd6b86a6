"""Holding a frame rate: when something is given up and taken back, and what that does to a picture."""

from __future__ import annotations

from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest

from rnd_runtime.playback.rasterizer import make_rasterizer
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.cameras import CameraOptions, frame_motion, front_path
from rnd_viewer.play.player import Player
from rnd_viewer.view.governor import FULL, LADDER, LADDER_AT_ONCE, Governor, Quality, enlarged
from support.play_fakes import FakeAvatar, fake_motion

MOTION = fake_motion()
CAMERA = front_path(frame_motion(FakeAvatar().skeleton, MOTION), CameraOptions(96, 80, 0.6, 0.1))(0, 0.0)


@pytest.mark.parametrize("ladder", [LADDER, LADDER_AT_ONCE])
def test_one_slow_frame_gives_nothing_up_and_steady_ones_do_step_by_step(ladder):
    governor = Governor(50, ladder)
    for seconds in (0.01, 0.5, 0.01, 0.01, 0.019, 0.019):
        governor.observe(seconds)
    assert governor.quality == FULL
    met = []
    for _ in range(60):
        governor.observe(0.021)
        met.append(ladder.index(governor.quality))
    assert sorted(set(met)) == list(range(len(ladder))) and met == sorted(met) and met[-1] == len(ladder) - 1


def test_room_is_used_only_after_a_calm_while():
    governor = Governor(fps=50)
    for _ in range(4):
        governor.observe(0.03)
    assert governor.quality == LADDER[1]
    for _ in range(100):
        governor.observe(0.015)  # within the budget, with no room for more
    assert governor.quality == LADDER[1]
    for _ in range(24):
        governor.observe(0.01)
    assert governor.quality == FULL


def test_the_ladder_takes_shading_before_resolution():
    assert LADDER[0] == FULL == Quality(1, 1.0)
    assert all(a.shade_every <= b.shade_every and a.scale >= b.scale for a, b in pairwise(LADDER))
    assert LADDER[1].scale == 1


def test_what_is_drawn_at_once_gives_up_no_shading():
    """A step of its own would cost more than it saves."""
    light = Light(np.ones((16, 32, 3), np.float32))

    def ladder(mode, rasterizer):
        return Player(FakeAvatar(), light, Shader(light, mode), rasterizer).ladder

    with closing(make_rasterizer("cpu")) as ours:
        assert ladder("table", ours) == ladder("table+sun", ours) == LADDER_AT_ONCE
        assert ladder("brute", ours) == ladder("ao", ours) == ladder("table", rasterize) == LADDER
    assert {quality.shade_every for quality in LADDER_AT_ONCE} == {1}


def test_enlarging_keeps_planes_and_constants():
    y, x = np.mgrid[:12, :17].astype(np.float32) + np.float32(0.5)
    plane = np.dstack([2 * x + 3 * y, np.ones_like(x)])
    large = enlarged(plane, 24, 34)
    v, u = np.mgrid[:24, :34] / 2 + 0.25
    inside = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(large[..., 0][inside], (2 * u + 3 * v)[inside], rtol=1e-5)
    np.testing.assert_array_equal(large[..., 1], 1)
    np.testing.assert_array_equal(enlarged(plane, 12, 17), plane)


@pytest.mark.parametrize(("quality", "least"), [(Quality(2), 40), (Quality(4, 0.5), 20), (Quality(1, 0.5), 20)])
def test_less_quality_looks_like_more(quality, least):
    """Against full quality in the same place of the motion, in dB; the first frame is shaded anew."""
    light = Light(np.linspace(2, 0, 16, dtype=np.float32)[:, None, None] * np.ones((16, 32, 3), np.float32))
    player = Player(FakeAvatar(), light, Shader(light, "table"), rasterize)
    whole = [player.render(MOTION, time, CAMERA) for time in (0.1, 0.12)]
    less = [player.draw(player.encode(MOTION, time), CAMERA, quality) for time in (0.1, 0.12)]
    for ours, full in zip(less, whole):
        assert ours.radiance.shape == full.radiance.shape and ours.alpha.shape == full.alpha.shape
        error = np.mean((ours.radiance - full.radiance) ** 2)
        assert error < 10 ** (-least / 10)
    if quality.scale == 1:  # shaded anew
        np.testing.assert_array_equal(less[0].radiance, whole[0].radiance)
    assert (less[1].radiance != whole[1].radiance).any()


def test_aovs_are_drawn_at_full_quality():
    light = Light(np.ones((16, 32, 3), np.float32))
    player = Player(FakeAvatar(), light, Shader(light, "table"), rasterize, aovs=("albedo",))
    encoded = player.encode(MOTION, 0.1)
    whole, less = (player.draw(encoded, CAMERA, quality) for quality in (FULL, Quality(1, 0.5)))
    np.testing.assert_array_equal(less.alpha, whole.alpha)
    np.testing.assert_array_equal(less.aovs["albedo"], whole.aovs["albedo"])


def test_after_a_frame_of_full_quality_nothing_older_is_used():
    light = Light(np.linspace(2, 0, 16, dtype=np.float32)[:, None, None] * np.ones((16, 32, 3), np.float32))
    player = Player(FakeAvatar(), light, Shader(light, "table"), rasterize)
    for time, quality in ((0.0, Quality(4)), (0.3, FULL)):
        player.draw(player.encode(MOTION, time), CAMERA, quality)
    again = player.draw(player.encode(MOTION, 0.3), CAMERA, Quality(4))
    np.testing.assert_array_equal(again.radiance, player.render(MOTION, 0.3, CAMERA).radiance)
