"""The compiled tone map against the two functions that define it, byte for byte."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.raster.tone import tone_map, tone_map_straight

RNG = np.random.default_rng(0)


def _picture():
    alpha = RNG.uniform(0, 1, (40, 50)).astype(np.float32)
    alpha[:5], alpha[5:9] = 0, 1
    return (alpha[..., None] * RNG.uniform(0, 1.3, (40, 50, 3))).astype(np.float32), alpha


def _over(radiance, alpha, behind):
    return to_bytes(linear_to_srgb(radiance + (1 - alpha)[..., None] * np.asarray(behind, np.float32)))


def test_every_float_between_two_steps_gets_its_code():
    """Around each of the 255 steps, ten floats either side; and the whole range on a grid of a million."""
    middles = ((np.arange(255) + 0.5) / 255 + 0.055) / 1.055
    linear = np.where(middles < 0.09, ((np.arange(255) + 0.5) / 255) / 12.92, middles**2.4).astype(np.float32)
    near = (linear.view(np.int32)[:, None] + np.arange(-10, 11)).astype(np.int32).view(np.float32)
    values = np.concatenate([near.ravel(), np.geomspace(1e-9, 2, 2**20).astype(np.float32)])
    values = np.resize(values, (len(values) // 300, 100, 3))
    np.testing.assert_array_equal(tone_map(values, np.ones(values.shape[:2])), to_bytes(linear_to_srgb(values)))


def test_what_is_no_radiance_has_a_code_all_the_same():
    values = np.array([[[np.nan, np.inf, -np.inf], [-1, -0.0, 0], [1, 1e30, 1e-40]]], np.float32)
    expected = [[[0, 255, 0], [0, 0, 0], [255, 255, 0]]]
    np.testing.assert_array_equal(tone_map(values, np.ones((1, 3))), expected)


@pytest.mark.parametrize("behind", [None, [0.2, 0.5, 3.0], "picture"])
def test_over_any_background(behind):
    radiance, alpha = _picture()
    if behind == "picture":
        behind = RNG.uniform(0, 2, radiance.shape).astype(np.float32)
    expected = _over(radiance, alpha, [0, 0, 0] if behind is None else behind)
    np.testing.assert_array_equal(tone_map(radiance, alpha, behind), expected)


def test_straight_alpha():
    radiance, alpha = _picture()
    opaque = np.where(alpha > 0, alpha, np.float32(1))[..., None]
    expected = np.dstack([to_bytes(linear_to_srgb(radiance / opaque)), to_bytes(alpha)])
    np.testing.assert_array_equal(tone_map_straight(radiance, alpha), expected)


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match="image"):
        tone_map(np.zeros((4, 5, 3)), np.zeros((5, 4)))
    with pytest.raises(InputError, match="background"):
        tone_map(np.zeros((4, 5, 3)), np.zeros((4, 5)), np.zeros((5, 4, 3)))


def test_a_share_of_the_background_is_seen():
    rng = np.random.default_rng(2)
    alpha = np.round(rng.random((9, 7)))
    radiance = 0.3 * alpha[..., None] * rng.random((9, 7, 3))
    share = np.where(rng.random((9, 7, 1)) < 0.5, 1, rng.random((9, 7, 3))).astype(np.float32)
    for behind in (np.float32([0.2, 0.5, 0.9]), rng.random((9, 7, 3)).astype(np.float32)):
        expected = tone_map(radiance, alpha, np.broadcast_to(behind, share.shape) * share)
        np.testing.assert_array_equal(tone_map(radiance, alpha, behind, share), expected)
    with pytest.raises(InputError, match="share of the background"):
        tone_map(radiance, alpha, behind, share[:3])
