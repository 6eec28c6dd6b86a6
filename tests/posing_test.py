"""Compiled posing against the plain float64 formulas and against the whole graph in onnxruntime."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.posing import RestPose
from rnd_runtime.posing_reference import pose_reference

ROUNDING = 3e-6  # float32 against float64, relative to the largest entry: products of three 3×3 matrices


def _scene(joints: int, *, count: int = 300, nodes: int = 40, harmonics: int = 16):
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
    rest, inputs = _scene(joints, harmonics=harmonics)
    for ours, exact in zip(rest.pose(*inputs), pose_reference(rest, *inputs)):
        assert ours.shape == exact.shape
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()


def test_without_logits_the_template_decides():
    rest, (_, *inputs) = _scene(24)
    for ours, exact in zip(rest.pose(None, *inputs), pose_reference(rest, None, *inputs)):
        assert np.abs(ours - exact).max() < ROUNDING * np.abs(exact).max()
