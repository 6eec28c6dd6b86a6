"""Compiled posing against the plain float64 formulas and against the whole graph in onnxruntime."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.posing.reference import pose_reference
from support.posing_scenes import BROKEN, broken_scene, posing_scene

ROUNDING = 3e-6  # float32 against float64, relative to the largest entry: products of three 3×3 matrices


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


@pytest.mark.parametrize(("field", "value"), BROKEN)
def test_what_is_no_number_stays_none_and_nothing_else_becomes_it(field, value):
    rest, inputs = broken_scene(field, value)
    with np.errstate(all="ignore"):
        exact = pose_reference(rest, *inputs)
    for ours, wanted in zip(rest.pose(*inputs)[:3], exact):  # visibility goes through nothing
        assert (np.isfinite(ours).all(1) == np.isfinite(wanted).all(1)).all()
