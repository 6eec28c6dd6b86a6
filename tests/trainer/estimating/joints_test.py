"""Our body in the joints of another program."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion
from rnd_trainer.estimating.joints import fit_joints
from support.paths import ASSETS

NAMES = 22


@pytest.fixture(scope="module")
def walking():
    """Joints [T, 22, 3] m of another body, the embedded one, its names."""
    body = Body.load(ASSETS / "body.npz")
    motion = load_motion(ASSETS / "walk.npz", body.skeleton)
    frames = np.arange(0, 24, 2)
    moved = body.skeleton.joint_transforms(motion.rotations[frames], motion.translations[frames])[:, :NAMES, :3, 3]
    return moved, body.skeleton.names[:NAMES]


def test_a_body_follows_the_joints_of_another(walking):
    positions, names = walking
    fitted = fit_joints(positions, names, 15.0)
    assert fitted.residual_m.max() < 0.02
    skeleton = fitted.body.skeleton
    found = skeleton.joint_transforms(fitted.motion.rotations, fitted.motion.translations)[:, :, :3, 3]
    limbs = [k for k, name in enumerate(names) if name.endswith(("knee", "ankle", "elbow", "wrist"))]
    ours = [skeleton.names.index(names[k]) for k in limbs]
    assert np.linalg.norm(found[:, ours] - positions[:, limbs], axis=-1).mean() < 0.035


def test_missing_positions_are_filled_in(walking):
    positions, names = walking
    holes = positions.copy()
    holes[4:6, names.index("left_wrist")] = np.nan
    fitted = fit_joints(holes, names, 15.0)
    skeleton = fitted.body.skeleton
    found = skeleton.joint_transforms(fitted.motion.rotations, fitted.motion.translations)[:, :, :3, 3]
    wrist = found[4:6, skeleton.names.index("left_wrist")]
    assert np.linalg.norm(wrist - positions[4:6, names.index("left_wrist")], axis=-1).max() < 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p, n: (p[:, :-4], n[:-4]), "no left_elbow"),
        (lambda p, n: (1000 * p, n), "0.2 to 3 m"),
        (lambda p, n: (p[0], n), "T × 22 × 3"),
    ],
    ids=["no arms", "millimetres", "one frame's shape"],
)
def test_refusals(walking, change, said):
    positions, names = change(*walking)
    with pytest.raises(InputError, match=said):
        fit_joints(positions, names, 15.0)
