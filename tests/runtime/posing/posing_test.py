"""Compiled posing against the plain float64 formulas and against the whole graph in onnxruntime."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.posing.posing import RestPose
from rnd_runtime.posing.reference import pose_reference

ROUNDING = 3e-6  # float32 against float64, relative to the largest entry: products of three 3×3 matrices


def template_logs(rng, count: int, joints: int, most: int):
    """As rnd-export writes them: up to ``most`` joints a Gaussian, the others at a floor of one in a million."""
    own = rng.permuted(np.tile(np.arange(joints) < most, (count, 1)), axis=1)
    return np.float32(np.where(own, rng.uniform(0, np.log(1e6), (count, joints)), 0.0))


def posing_scene(joints: int, *, count: int = 300, nodes: int = 40, harmonics: int = 16, most: int = 5):
    """Nodes agree on Δ logits, up to a constant each, which no softmax sees: nothing is lost in interpolating."""
    rng = np.random.default_rng(joints)
    weights = rng.uniform(0.1, 1, (count, 4))
    normals = rng.normal(size=(count, 3))
    rest = RestPose(
        rng.integers(0, nodes, (count, 4)).astype(np.int32),
        np.float32(weights / weights.sum(1, keepdims=True)),
        template_logs(rng, count, joints, most),
        np.float32(rng.normal(size=(count, 3))),
        np.float32(0.02 * rng.normal(size=(count, 9))),
        np.float32(normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        np.float32(
            np.concatenate(
                [normals[::-1] / np.linalg.norm(normals[::-1], axis=1, keepdims=True), 0.1 * normals, weights[:, :1]], 1
            )
        ),
        max_offset=0.06,
        floor=1e-8,
        fallback=1e-3,
    )
    logits = np.float32(2 * rng.normal(size=joints) + rng.normal(size=(nodes, 1)))
    offsets = np.float32(2 * rng.normal(size=(nodes, 6)))
    visibility = np.float32(rng.normal(size=(nodes, harmonics)))
    bones = np.float32(np.eye(3, 4) + 0.3 * rng.normal(size=(joints, 3, 4)))
    return rest, (logits, offsets, visibility, bones)


@pytest.mark.parametrize(
    ("joints", "harmonics", "most"), [(24, 16, 5), (2, 1, 1), (16, 9, 16), (55, 16, 2), (33, 4, 12), (1, 16, 1)]
)
def test_posing_is_the_float64_formula(joints, harmonics, most):
    rest, inputs = posing_scene(joints, harmonics=harmonics, most=most)
    for ours, exact in zip(rest.pose(*inputs), pose_reference(rest, *inputs)):
        assert ours.shape == exact.shape
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()


@pytest.mark.parametrize("apart", [0.3, 2.0])
def test_where_nodes_differ_no_more_is_lost_than_the_floors_share(apart):
    """Of means: the floor's weights, by the mean of exponentials less the exponential of the mean, times how far apart
    any two joints would take the Gaussian."""
    rest, (logits, *others) = posing_scene(24)
    logits = np.float32(logits + apart * np.random.default_rng(1).normal(size=logits.shape))
    ours = rest.pose(logits, *others).means
    exact = pose_reference(rest, logits, *others)[0]
    changes = np.float64(logits)[rest.neighbours]
    changes -= changes.max(2, keepdims=True)
    weights = np.float64(rest.neighbour_weights)[..., None]
    geometric, arithmetic = np.exp((changes * weights).sum(1)), (np.exp(changes) * weights).sum(1)
    whole = (np.exp(np.float64(rest.log_template)) * geometric).sum(1)
    share = 2 * (arithmetic - geometric).sum(1) / whole  # the weights sum to 1, so others lose what some gain
    points = np.concatenate([rest.points, np.ones((len(ours), 1))], 1)
    places = np.einsum("jrc,nc->njr", np.float64(others[2]), points)
    reach = np.linalg.norm(places - exact[:, None], axis=2).max(1) + rest.max_offset * 3
    assert share.max() > 1e-6
    assert (np.linalg.norm(ours - exact, axis=1) < share * reach + ROUNDING * np.abs(exact).max()).all()


def test_deep_and_dense_templates_are_finite_and_right():
    """A template no exporter of ours writes: no floor, and weights as small as float32 can be."""
    rest, (logits, *others) = posing_scene(24)
    rng = np.random.default_rng(2)
    rest = replace(rest, log_template=np.float32(rng.uniform(-200, 0, rest.log_template.shape)))
    for ours, exact in zip(rest.pose(logits, *others), pose_reference(rest, logits, *others)):
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()


def test_logits_of_any_size_move_nothing_but_what_they_differ_by():
    rest, (logits, *others) = posing_scene(24)
    exact = pose_reference(rest, logits, *others)
    for far in (-300.0, 300.0):
        for ours, wanted in zip(rest.pose(logits + np.float32(far), *others), exact):
            assert np.abs(ours - wanted).max() < 30 * ROUNDING * np.abs(wanted).max()  # of float32 at 300


def test_without_logits_the_template_decides():
    rest, (_, *inputs) = posing_scene(24)
    for ours, exact in zip(rest.pose(None, *inputs), pose_reference(rest, None, *inputs)):
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()


BROKEN = [
    (field, value)
    for field in ("logits", "log_template", "offsets", "turns", "bones", "points")
    for value in (np.nan, np.inf, -np.inf)
]


def broken_scene(field, value):
    """A scene of 24 joints with one number of Gaussian 0's that is not finite."""
    rest, (logits, offsets, visibility, bones) = posing_scene(24)
    changed = {"log_template": rest.log_template.copy(), "points": rest.points.copy()}
    places = {
        "logits": (logits, (rest.neighbours[0, 0], 2)),
        "offsets": (offsets, (rest.neighbours[0, 0], 1)),
        "turns": (offsets, (rest.neighbours[0, 0], 4)),
        "bones": (bones, (3, 0, 0)),
        **{name: (array, (0, 2)) for name, array in changed.items()},
    }
    array, place = places[field]
    array[place] = value
    return replace(rest, **changed), (logits, offsets, visibility, bones)


@pytest.mark.parametrize(("field", "value"), BROKEN)
def test_what_is_no_number_stays_none_and_nothing_else_becomes_it(field, value):
    rest, inputs = broken_scene(field, value)
    with np.errstate(all="ignore"):
        exact = pose_reference(rest, *inputs)
    for ours, wanted in zip(rest.pose(*inputs)[:3], exact):  # visibility goes through nothing
        assert (np.isfinite(ours).all(1) == np.isfinite(wanted).all(1)).all()
