"""Coarser levels: pairs by moments, alike first, against sums written out."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from rnd_runtime.posing import levels
from rnd_runtime.posing.levels import GROWTH, KEPT, MergedLevels, Surface


@pytest.fixture(scope="module")
def surface(avatar):
    return Surface(avatar._rest, avatar._opacities, avatar._albedo, avatar._roughness)


@pytest.fixture(autouse=True)
def _however_few(monkeypatch):
    monkeypatch.setattr(levels, "MIN_GAUSSIANS", 0)


def _next(surface):
    made = MergedLevels(surface)
    count = made.count(1)
    return surface if count is None else made.surface(1)


def _some(surface, rows, **changes):
    names = ("neighbours", "neighbour_weights", "log_template", "points", "factors", "normals", "limbs")
    rest = replace(surface.rest, **{name: getattr(surface.rest, name)[rows] for name in names} | changes)
    return Surface(rest, *(values[rows] for values in surface[1:]))


def test_a_level_keeps_its_share_and_the_body(surface):
    level = _next(surface)
    count = len(surface.opacities)
    assert len(level.opacities) == round(KEPT * count) == len(level.rest.points)
    unchanged = {tuple(point) for point in surface.rest.points} & {tuple(point) for point in level.rest.points}
    assert len(unchanged) == count - 2 * (count - len(level.opacities))  # everybody else is one of a pair
    # alike pairs merge first, so the mean of all shifts: by a hundredth of the body at most
    np.testing.assert_allclose(level.rest.points.mean(0), surface.rest.points.mean(0), atol=0.0175)
    np.testing.assert_allclose(np.linalg.norm(level.rest.normals, axis=1), 1, atol=1e-5)
    assert np.ptp(level.rest.points, axis=0) == pytest.approx(np.ptp(surface.rest.points, axis=0), abs=0.02)


def test_a_pair_is_merged_by_moments_and_grows(surface, monkeypatch):
    """Four points: two near one another and of one colour, two of other colours."""
    monkeypatch.setattr(levels, "KEPT", 0.75)
    points = np.float32([[0, 0, 0], [0.01, 0, 0], [0, 0.012, 0], [0.01, 0.012, 0]])
    factors = np.zeros((4, 9), np.float32)
    factors[:, [0, 4, 8]] = [[0.01, 0.01, 0.001], [0.01, 0.01, 0.001], [0.01, 0.01, 0.001], [0.01, 0.01, 0.001]]
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    four = _some(surface, np.arange(4), points=points, factors=factors, normals=normals)
    opacities = np.float32([0.9, 0.6, 0.9, 0.9])
    albedo = np.float32([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8]])
    merged = _next(Surface(four.rest, opacities, albedo, four.roughness))
    assert len(merged.opacities) == 3
    (row,) = np.flatnonzero(~(merged.rest.points[:, None] == points).all(2).any(1))
    share = 0.9 / 1.5
    np.testing.assert_allclose(merged.rest.points[row], [0.01 * (1 - share), 0, 0], atol=1e-8)
    np.testing.assert_allclose(merged.opacities[row], share * 0.9 + (1 - share) * 0.6, rtol=1e-6)
    factor = merged.rest.factors[row].reshape(3, 3).astype(np.float64)
    along, across = 1e-4 + share * (1 - share) * 1e-4, 1e-4
    growth = (2e-4 / np.sqrt(along * across)) ** GROWTH
    np.testing.assert_allclose(factor @ factor.T, np.diag([growth * along, growth * across, 1e-6]), atol=1e-9)


def test_sides_of_a_thin_body_are_not_merged(surface):
    """Two sheets a millimetre apart that face away from one another, each of one colour."""
    grid = np.stack(np.meshgrid(*2 * [0.01 * np.arange(12)]), -1).reshape(-1, 2)
    count = len(grid)
    points = np.float32(np.concatenate([np.c_[grid, np.zeros(count)], np.c_[grid, np.full(count, 0.001)]]))
    normals = np.repeat(np.float32([[0, 0, -1], [0, 0, 1]]), count, axis=0)
    two = _some(surface, np.arange(2 * count), points=points, normals=normals)
    albedo = np.repeat(np.float32([[1, 0, 0], [0, 0, 1]]), count, axis=0)
    level = _next(Surface(two.rest, two.opacities, albedo, two.roughness))
    assert len(level.opacities) < 2 * count
    assert {tuple(colour) for colour in level.albedo} == {(1, 0, 0), (0, 0, 1)}
    np.testing.assert_array_equal(level.rest.points[:, 2] > 0.0005, level.albedo[:, 2] > 0.5)


def test_a_lone_gaussian_stays(surface):
    one = _some(surface, np.arange(1))
    made = MergedLevels(one)
    assert [made.count(number) for number in (1, 1, 0)] == [None, None, 1]


def test_levels_are_made_again_and_few_are_kept(surface, monkeypatch):
    made = MergedLevels(surface)
    counts = [made.count(number) for number in range(12)]
    assert all(round(KEPT * before) == after for before, after in pairwise(counts))
    monkeypatch.setattr(levels, "ROWS_AT_HAND", 3 * counts[0])
    first = [made.surface(number) for number in range(12)]
    kept = [number for number in reversed(range(12)) if made.surface(number) is first[number]]
    assert kept == [11, 10, 9, 0]
    for number in (0, 3, 11):
        again = made.surface(number)
        assert len(again.opacities) == counts[number]
        for name in ("points", "factors", "neighbours", "limbs"):
            np.testing.assert_array_equal(getattr(again.rest, name), getattr(first[number].rest, name))
        np.testing.assert_array_equal(again.albedo, first[number].albedo)
