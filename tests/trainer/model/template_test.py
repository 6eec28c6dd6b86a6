"""Even sampling of a template and its interpolation weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rnd_runtime.capture.body import skin
from rnd_runtime.core.errors import InputError
from rnd_trainer.model.template import BUCKET, farthest_points, sample_template
from support.tiny import body


@pytest.fixture(scope="module")
def template():
    return sample_template(body(), 2000, 500, seed=0)


def test_samples_are_on_the_surface_and_evenly_spaced(template) -> None:
    surface = cKDTree(body().vertices).query(template.points)[0]
    assert surface.max() < 0.03  # no farther than an edge of the template
    nearest = cKDTree(template.codes).query(template.codes, k=2)[0][:, 1]
    assert nearest.min() > 0.5 * template.spacing  # random points come as close as a hundredth


def test_every_prefix_covers_the_body(template) -> None:
    for count in (100, 500):
        gap = cKDTree(template.codes[:count]).query(template.codes)[0].max()
        assert gap < 2.0 * template.spacing * np.sqrt(2000 / count)


def test_weights_are_partitions_of_one(template) -> None:
    for weights in (template.weights, template.neighbour_weights):
        assert weights.min() >= 0
        assert np.abs(weights.sum(1) - 1).max() < 1e-9
    assert template.neighbours.max() < template.nodes


def test_interpolation_is_smooth(template) -> None:
    heights = template.codes[: template.nodes, 1]
    interpolated = (heights[template.neighbours] * template.neighbour_weights).sum(1)
    assert np.abs(interpolated - template.codes[:, 1]).max() < 2 * template.spacing * 2  # within two node spacings


@pytest.mark.parametrize("candidates", (1, BUCKET - 1, 10 * BUCKET + 1))
@pytest.mark.parametrize("lattice", (False, True), ids=("scattered", "ties"))
def test_farthest_points_equal_exhaustive_search(candidates, lattice) -> None:
    rng = np.random.default_rng(candidates)
    points = rng.integers(0, 5, (candidates, 3)) if lattice else rng.normal(size=(candidates, 3))
    points, first = points.astype(np.float32), candidates // 3
    plain, nearest = [first], np.full(candidates, np.inf, np.float32)
    while len(plain) < candidates:
        x, y, z = (points - points[plain[-1]]).T
        nearest = np.minimum(nearest, x * x + y * y + z * z)
        plain.append(int(nearest.argmax()))
    assert np.array_equal(farthest_points(points, candidates, first), plain)


def test_same_seed_same_points(template) -> None:
    again = sample_template(body(), 2000, 500, seed=0)
    assert np.array_equal(again.points, template.points)
    assert not np.array_equal(sample_template(body(), 2000, 500, seed=1).points, template.points)


def test_spread_pose_separates_the_legs(template) -> None:
    names = body().skeleton.names
    left = template.weights[:, names.index("left_hip")] > 0.9
    right = template.weights[:, names.index("right_hip")] > 0.9

    def gap(points):
        return cKDTree(points[left]).query(points[right])[0].min()

    assert gap(template.codes) > gap(template.points) + 0.02


def test_skinning_by_identity_changes_nothing(template) -> None:
    bones = np.tile(np.eye(3, 4), (24, 1, 1))
    assert np.allclose(skin(template.points, template.weights, bones), template.points, atol=1e-12)


def test_too_many_nodes_are_refused() -> None:
    with pytest.raises(InputError, match="nodes: expected 16 to 100"):
        sample_template(body(), 100, 200, seed=0)


@pytest.mark.parametrize("what", ["faces", "area"])
def test_a_body_without_a_surface_is_refused(what) -> None:
    """No faces, or each of them a point."""
    flat = body()
    faces = flat.faces[:0] if what == "faces" else flat.faces[:, :1].repeat(3, 1)
    with pytest.raises(InputError, match=rf"faces of the body: expected a surface, got {len(faces)} faces, 0 m²"):
        sample_template(replace(flat, faces=faces), 100, 20, seed=0)
