"""Compiled posing against the plain float64 formulas and against the whole graph in onnxruntime."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.posing import RestPose
from rnd_runtime.posing_reference import pose_reference

ROUNDING = 3e-6  # float32 against float64, relative to the largest entry: products of three 3×3 matrices


def posing_scene(joints: int, *, count: int = 300, nodes: int = 40, harmonics: int = 16):
    rng = np.random.default_rng(joints)
    weights = rng.uniform(0.1, 1, (count, 4))
    normals = rng.normal(size=(count, 3))
    rest = RestPose(
        rng.integers(0, nodes, (count, 4)).astype(np.int32),
        np.float32(weights / weights.sum(1, keepdims=True)),
        np.float32(3 * rng.normal(size=(count, joints))),
        np.float32(rng.normal(size=(count, 3))),
        np.float32(0.02 * rng.normal(size=(count, 9))),
        np.float32(normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        np.float32(
            np.concatenate(
                [
                    normals[::-1] / np.linalg.norm(normals[::-1], axis=1, keepdims=True),
                    0.1 * normals,
                    weights[:, :1],
                ],
                1,
            )
        ),
        max_offset=0.06,
        floor=1e-8,
        fallback=1e-3,
    )
    logits = np.float32(2 * rng.normal(size=(nodes, joints)))
    offsets = np.float32(2 * rng.normal(size=(nodes, 6)))
    visibility = np.float32(rng.normal(size=(nodes, harmonics)))
    bones = np.float32(np.eye(3, 4) + 0.3 * rng.normal(size=(joints, 3, 4)))
    return rest, (logits, offsets, visibility, bones)


@pytest.mark.parametrize(("joints", "harmonics"), [(24, 16), (2, 1), (16, 9), (55, 16), (33, 4)])
def test_posing_is_the_float64_formula(joints, harmonics):
    rest, inputs = posing_scene(joints, harmonics=harmonics)
    for ours, exact in zip(rest.pose(*inputs), pose_reference(rest, *inputs)):
        assert ours.shape == exact.shape
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()


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
