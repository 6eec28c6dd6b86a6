"""Widening of twisted limbs, and the axes of bones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.model.skinning import cofactor
from rnd_trainer.model.twist import TwistFrames, bone_axes, excess, twist_frames
from support.tiny import body

EXACT = 1e-12


def _half_blend(axis_angle) -> torch.Tensor:
    """[1, 3, 3], half of a bone at rest and half of a rotated one."""
    return torch.as_tensor(0.5 * (np.eye(3) + axis_angle_to_matrix(np.asarray(axis_angle, float))))[None]


def _limb(share: float = 1.0) -> TwistFrames:
    """Along x, 5 cm thick."""
    axis = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    lever = torch.tensor([[0, 0.05, 0]], dtype=torch.float64)
    return TwistFrames(axis, share * lever, torch.tensor([share], dtype=torch.float64))


def _excess(axis_angle, limb: TwistFrames | None = None) -> float:
    blend = _half_blend(axis_angle)
    return float(excess(blend, cofactor(blend), limb or _limb()))


@pytest.mark.parametrize(("degrees", "kept"), [(30, 0.999), (60, 0.999), (90, 0.99), (120, 0.97), (150, 0.73)])
def test_a_twisted_limb_keeps_its_cross_section(degrees: float, kept: float) -> None:
    lost = np.cos(np.radians(degrees / 2))
    assert kept <= lost * (1 + _excess([np.radians(degrees), 0, 0])) <= 1


def test_widening_is_smooth_through_180_degrees() -> None:
    near = [_excess([np.pi + step, 0, 0]) for step in (-1e-3, 0, 1e-3)]
    assert abs(near[0] - near[1]) < 1e-5 and abs(near[2] - near[1]) < 1e-5
    assert near[1] == pytest.approx((3 / 2) ** 3 - 1, abs=1e-6)


@pytest.mark.parametrize("degrees", [0, 45, 90, 150])
def test_bends_and_rigid_motions_are_not_widened(degrees: float) -> None:
    for axis in ([0, 1, 0], [0, 0.6, -0.8]):
        assert _excess(np.radians(degrees) * np.array(axis)) == pytest.approx(0, abs=EXACT)
    rigid = torch.as_tensor(axis_angle_to_matrix(np.radians(degrees) * np.array([0.6, 0, 0.8])))[None]
    assert float(excess(rigid, cofactor(rigid), _limb())) == pytest.approx(0, abs=EXACT)


def test_only_limbs_are_widened_and_a_zero_blend_is_finite() -> None:
    assert _excess([2.0, 0, 0], _limb(share=0.0)) == 0
    nothing = torch.zeros(1, 3, 3, dtype=torch.float64)
    assert torch.isfinite(excess(nothing, nothing, _limb())).all()


def test_axes_run_along_the_limbs_and_levers_across_them() -> None:
    template = body()
    names = template.skeleton.names
    axes = bone_axes(template.skeleton)
    joints = template.skeleton.rest_joints
    forearm = joints[names.index("left_wrist")] - joints[names.index("left_elbow")]
    assert abs(axes[names.index("left_elbow")] @ forearm) == pytest.approx(np.linalg.norm(forearm))
    for trunk in ("pelvis", "spine1", "spine2", "spine3", "neck"):
        assert axes[names.index(trunk)][1] > 0.9  # up, not towards a hip or a shoulder

    axes, levers, shares = twist_frames(template.vertices, template.skinning_weights.astype(float), template.skeleton)
    assert np.abs((axes * levers).sum(1)).max() < 1e-9
    assert shares.min() >= 0 and shares.max() <= 1 + EXACT
    on_forearm = template.skinning_weights[:, names.index("left_elbow")] > 0.95
    assert shares[on_forearm].min() > 0.9
    outward = template.vertices[on_forearm] - joints[names.index("left_elbow")]
    along = forearm / np.linalg.norm(forearm)
    expected = outward - np.outer(outward @ along, along)
    assert np.abs(levers[on_forearm] - expected).max() < 0.01
