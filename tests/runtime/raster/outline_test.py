"""What is done to outlines: the formula in float64, and what it must leave alone."""

import numpy as np
import pytest

from rnd_runtime.core.gaussians import Raster
from rnd_runtime.raster.outline import sharpened

EXACT = 3e-7  # float32, four operations: relative


@pytest.fixture
def raster():
    rng = np.random.default_rng(4)
    alpha = rng.random((37, 21))
    alpha[:3], alpha[3:6] = 0, 1
    image, depth = rng.random((37, 21, 5)) * 1e3, rng.random((37, 21)) * 4
    arrays = (image * alpha[..., None], alpha, depth * alpha)
    return Raster(*(np.asarray(values, np.float32) for values in arrays), {"raster": 0.5, "sort": 0.1})


def copied(raster):
    return tuple(np.array(values, np.float64) for values in (raster.image, raster.alpha, raster.depth))


def test_coverage_is_steepened_and_all_that_is_premultiplied_by_it_along(raster):
    image, alpha, depth = copied(raster)
    ours = sharpened(raster)
    factor = alpha * (3 - 2 * alpha)
    factor[alpha == 0] = 1
    np.testing.assert_allclose(ours.alpha, alpha * factor, rtol=EXACT)
    np.testing.assert_allclose(ours.image, image * factor[..., None], rtol=EXACT)
    np.testing.assert_allclose(ours.depth, depth * factor, rtol=EXACT)
    assert ours.seconds["raster"] > 0.5 and ours.seconds["sort"] == 0.1


def test_nothing_full_coverage_and_a_half_stay(raster):
    raster.alpha[6:9] = 0.5
    still = (raster.alpha == 0) | (raster.alpha == 1) | (raster.alpha == 0.5)
    before = copied(raster)
    ours = sharpened(raster)
    for was, now in zip(before, copied(ours)):
        np.testing.assert_array_equal(was[still], now[still])


def test_an_edge_keeps_its_place_and_no_coverage_leaves_its_range():
    ramp = np.linspace(0, 1, 1001, dtype=np.float32)[None]
    zeros = np.zeros((1, 1001), np.float32)
    ours = sharpened(Raster(zeros[..., None], ramp.copy(), zeros)).alpha[0]
    assert (np.diff(ours) >= 0).all() and ours[0] == 0 and ours[-1] == 1
    np.testing.assert_allclose(ours + ours[::-1], 1, atol=EXACT)  # as much is added inside as is taken outside


def test_pictures_that_cannot_be_written_to_are_copied(raster):
    alpha = raster.alpha.copy()
    for values in (raster.image, raster.alpha, raster.depth):
        values.setflags(write=False)
    ours = sharpened(raster)
    np.testing.assert_array_equal(raster.alpha, alpha)
    assert (ours.alpha != alpha).any()
