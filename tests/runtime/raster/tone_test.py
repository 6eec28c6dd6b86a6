"""The compiled tone map against the two functions that define it, byte for byte."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, neutral, srgb_to_linear, to_bytes
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


def test_the_neutral_curve_is_the_published_one():
    """Khronos' function, statement by statement, on each pixel; where it begins, ends and bends."""

    def published(color):
        color = np.array(color, np.float64)
        x = color.min()
        color -= x - 6.25 * x * x if x < 0.08 else 0.04
        peak = color.max()
        if peak < 0.8 - 0.04:
            return color
        d = 1 - (0.8 - 0.04)
        new_peak = 1 - d * d / (peak + d - (0.8 - 0.04))
        color *= new_peak / peak
        g = 1 - 1 / (0.15 * (peak - new_peak) + 1)
        return color * (1 - g) + new_peak * g

    values = 10 ** RNG.uniform(-4, 4, (4000, 3))
    values = np.concatenate([values, RNG.uniform(0.5, 1, (4000, 3)), [[0, 0, 0], [0.08, 0.5, 0.8], [0.8, 0.8, 0.8]]])
    np.testing.assert_allclose(neutral(values), [published(value) for value in values], rtol=1e-12, atol=1e-15)
    grey = np.repeat(np.geomspace(1e-4, 1e6, 5000)[:, None], 3, axis=1)
    assert (np.diff(neutral(grey)[:, 0]) >= 0).all() and neutral(grey).max() < 1 < 1.04 * neutral(grey).max()
    np.testing.assert_array_equal(neutral([[np.nan, np.inf, -1], [np.inf] * 3]), [[1, 1, 1], [1, 1, 1]])


@pytest.mark.parametrize("behind", [None, [0.2, 0.5, 3.0], "picture"])
def test_the_neutral_curve_over_any_background(behind):
    """Against float64: a code may differ by one where rounding crosses a step, at one number in a thousand."""
    radiance, alpha = _picture()
    radiance *= np.float32(4) ** RNG.uniform(-4, 4, (*alpha.shape, 1)).astype(np.float32)
    if behind == "picture":
        behind = RNG.uniform(0, 2, radiance.shape).astype(np.float32)
    seen = (1.0 - alpha)[..., None] * np.asarray([0, 0, 0] if behind is None else behind)
    opaque = np.where(alpha > 0, alpha, 1)[..., None].astype(np.float64)
    straight = neutral(radiance / opaque)
    over = neutral(radiance + seen) if np.ndim(behind) == 3 else opaque * straight + seen
    for ours, expected in (
        (tone_map(radiance, alpha, behind, tone="neutral"), to_bytes(linear_to_srgb(over))),
        (tone_map_straight(radiance, alpha, tone="neutral")[..., :3], to_bytes(linear_to_srgb(straight))),
    ):
        apart = np.abs(ours.astype(int) - expected)
        assert apart.max() <= 1 and np.count_nonzero(apart) <= apart.size // 1000
        assert (expected < 255).any() and (expected > 250).any()


def test_a_colour_behind_the_body_comes_out_as_it_is_under_every_tone():
    empty = np.zeros((2, 3, 3), np.float32), np.zeros((2, 3), np.float32)
    for level in range(256):
        named = np.uint8([level, 255 - level, (37 * level) % 256])
        for tone in ("srgb", "neutral"):
            assert (tone_map(*empty, srgb_to_linear(named / 255), tone=tone) == named).all()


def test_the_neutral_curve_of_what_is_no_radiance():
    values = np.array([[[np.nan, np.inf, -np.inf], [-1, -0.0, 0], [1e30, 1e30, 1e30]]], np.float32)
    expected = [[[255, 255, 255], [0, 0, 0], [255, 255, 255]]]
    np.testing.assert_array_equal(tone_map(values, np.ones((1, 3)), tone="neutral"), expected)
