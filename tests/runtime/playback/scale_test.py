"""Frames at less than their full resolution."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.enlarge import enlarged
from rnd_runtime.shading.light import Light
from support.play_fakes import FakeAvatar, fake_motion

CAMERA = Camera.look_at([0.3, 1, 3.2], [0.3, 0.85, 0], width=96, height=80, fov_y=0.6)
MOTION = fake_motion()


@pytest.fixture
def renderer():
    light = Light(np.linspace(2, 0, 16, dtype=np.float32)[:, None, None] * np.ones((16, 32, 3), np.float32))
    return FrameRenderer(FakeAvatar(), light, CAMERA, shade="table", raster=rasterize)


def test_enlarging_keeps_planes_and_constants():
    y, x = np.mgrid[:12, :17].astype(np.float32) + np.float32(0.5)
    plane = np.dstack([2 * x + 3 * y, np.ones_like(x)])
    large = enlarged(plane, 24, 34)
    v, u = np.mgrid[:24, :34] / 2 + 0.25
    inside = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(large[..., 0][inside], (2 * u + 3 * v)[inside], rtol=1e-5)
    np.testing.assert_array_equal(large[..., 1], 1)
    np.testing.assert_array_equal(enlarged(plane, 12, 17), plane)


def test_half_the_resolution_looks_like_all_of_it(renderer):
    encoded = renderer.avatar.encode(MOTION, 0.1)
    full, half = (renderer.draw(encoded, scale=scale) for scale in (1, 0.5))
    assert half.radiance.shape == full.radiance.shape and half.srgb.shape == full.srgb.shape
    assert 0 < np.mean((half.radiance - full.radiance) ** 2) < 1e-2


def test_aovs_are_rendered_in_full(renderer):
    encoded = renderer.avatar.encode(MOTION, 0.1)
    full, half = (renderer.draw(encoded, aovs=("albedo",), scale=scale) for scale in (1, 0.5))
    np.testing.assert_array_equal(half.alpha, full.alpha)
    np.testing.assert_array_equal(half.aovs["albedo"], full.aovs["albedo"])
