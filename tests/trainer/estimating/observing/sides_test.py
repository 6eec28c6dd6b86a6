"""Skeletons of several views of each frame: swapped sides and lost limbs are found by their path over time."""

import numpy as np
import pytest

from rnd_trainer.estimating.observations import BLAZEPOSE
from rnd_trainer.estimating.observing.landmarks import MIRRORED
from rnd_trainer.estimating.observing.sides import cheapest_path, merge_views

FRAMES, VIEWS, SIZE = 30, 4, 300.0


def walking(seed: int = 0) -> np.ndarray:
    """Points [T, V, 33, 2] of a person whose left is 80 pixels beside the right, with a pixel of noise."""
    rng = np.random.default_rng(seed)
    base = rng.uniform(0, 150, (33, 2))
    for k, name in enumerate(BLAZEPOSE):
        base[k, 0] += 80 * name.startswith("left") + 40 * (name == "nose")
        base[k, 1] = base[min(k, MIRRORED[k]), 1]
    path = base + np.stack([3.0 * np.arange(FRAMES), np.zeros(FRAMES)], 1)[:, None]
    return path[:, None] + rng.normal(size=(FRAMES, VIEWS, 33, 2))


def merged(points: np.ndarray, outside: np.ndarray | None = None, confidence: np.ndarray | None = None):
    metres = np.concatenate([points, points[..., :1]], -1) / 100
    sure = np.full(points.shape[:3], 0.9) if confidence is None else confidence
    away = np.zeros(points.shape[:3]) if outside is None else outside
    return merge_views(points, metres, sure, away, np.full(FRAMES, SIZE), np.arange(FRAMES) / 15)


def test_views_that_swap_left_and_right_are_put_right() -> None:
    points = walking()
    truth = points.mean(1)
    for frame, views in ((4, [1]), (11, [0, 2]), (12, [0, 1, 2]), (20, [0, 1, 2, 3])):
        points[frame, views] = points[frame, views][:, MIRRORED]
    found = merged(points)
    assert np.abs(found.points - truth).max() < 4
    assert np.abs(found.metres[..., :2] - truth / 100).max() < 0.04
    assert found.confidence[11].mean() < 0.6 * found.confidence[10].mean()  # the views of frame 11 disagree


def test_a_limb_seen_in_the_background_is_taken_from_the_other_views() -> None:
    points = walking()
    truth = points.mean(1)
    wrist, arm = BLAZEPOSE.index("right_wrist"), [BLAZEPOSE.index(f"right_{n}") for n in ("elbow", "wrist", "index")]
    outside = np.zeros(points.shape[:3])
    points[8:16, :3, arm] += 120  # most views agree on something that is no limb
    outside[8:16, :3, arm] = 90
    found = merged(points, outside)
    assert np.linalg.norm(found.points[8:16, wrist] - truth[8:16, wrist], axis=-1).max() < 5
    assert found.confidence[8:16, wrist].max() < 0.5 < found.confidence[:8, wrist].min()


def test_where_all_views_lose_a_limb_nothing_is_believed() -> None:
    points = walking()
    arm = [BLAZEPOSE.index(f"right_{n}") for n in ("elbow", "wrist", "index")]
    outside = np.zeros(points.shape[:3])
    points[8:16, :, arm] += 120
    outside[8:16, :, arm] = 90
    assert merged(points, outside).confidence[8:16][:, arm].max() < 0.01


def test_the_path_of_least_cost() -> None:
    rng = np.random.default_rng(1)
    costs, steps = rng.uniform(size=(6, 3)), rng.uniform(size=(5, 3, 3))
    every = np.stack(np.meshgrid(*[np.arange(3)] * 6, indexing="ij"), -1).reshape(-1, 6)
    total = sum(costs[t, every[:, t]] for t in range(6)) + sum(steps[t, every[:, t], every[:, t + 1]] for t in range(5))
    np.testing.assert_array_equal(cheapest_path(costs, steps), every[np.argmin(total)])


@pytest.mark.parametrize(
    "name, other", [("left_wrist", "right_wrist"), ("mouth_left", "mouth_right"), ("nose", "nose")]
)
def test_mirrored_points(name: str, other: str) -> None:
    assert BLAZEPOSE[MIRRORED[BLAZEPOSE.index(name)]] == other
