"""Formats of other programs that are retargeted or fitted: a walk in each comes back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.formats.vectors import humanml_positions
from rnd_runtime.motion.motion import load_motion
from support.foreign_motion import (
    JOINTS,
    MATRICES,
    PELVIS,
    humanml_numbers,
    write_gemx,
    write_glb,
    write_kimodo,
    write_sam3d,
    write_somax,
)
from support.known_motion import SKELETON, write_pickle

LIMBS = ("shoulder", "elbow", "hip", "knee")
POINTS, ROLLS = 2.0, 6.0  # degrees: of limbs' directions, of their rotations
POSITIONS_ALONE = 4.0


def _directions(rotations: np.ndarray) -> np.ndarray:
    """Of the limbs' bones [F, 8, 3]."""
    joints = SKELETON.joint_transforms(rotations, np.zeros(3))[..., :3, 3]
    below = {name: k for k, name in enumerate(SKELETON.names)}
    pairs = [
        (below[f"{side}_{a}"], below[f"{side}_{b}"])
        for side in ("left", "right")
        for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
    ]
    bones = np.stack([joints[:, b] - joints[:, a] for a, b in pairs], 1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def _worst_direction(motion) -> float:
    cosines = (_directions(motion.rotations) * _directions(MATRICES)).sum(-1)
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


def _worst_rotation(motion) -> float:
    """Of the limbs' joints in the world, degrees."""
    worst = 0.0
    given = SKELETON.joint_transforms(motion.rotations, np.zeros(3))[..., :3, :3]
    known = SKELETON.joint_transforms(MATRICES, np.zeros(3))[..., :3, :3]
    for k, name in enumerate(SKELETON.names):
        if name.endswith(LIMBS):
            between = Rotation.from_matrix(given[:, k].swapaxes(-1, -2) @ known[:, k])
            worst = max(worst, float(np.degrees(between.magnitude()).max()))
    return worst


def _path_off(motion) -> float:
    """Largest distance in m of the pelvis' path to the known one, but for its scale, floor and beginning."""
    path, known = motion.translations - motion.translations[0], PELVIS - PELVIS[0]
    scale = (path * known).sum() / (known * known).sum()
    assert 0.8 < scale < 1.25
    return float(np.linalg.norm(path - scale * known, axis=1).max())


MIXAMO = [
    f"mixamorig:{name}"
    for name in (
        *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot"),
        *("Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm"),
        *("RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand", "LeftHandIndex1", "RightHandIndex1"),
    )
]
BONES = [f"bone {k}" for k in range(24)]
VRM = (
    *("hips", "leftUpperLeg", "rightUpperLeg", "spine", "leftLowerLeg", "rightLowerLeg", "chest", "leftFoot"),
    *("rightFoot", "upperChest", "leftToes", "rightToes", "neck", "leftShoulder", "rightShoulder", "head"),
    *("leftUpperArm", "rightUpperArm", "leftLowerArm", "rightLowerArm", "leftHand", "rightHand"),
)
VRM_0 = {"VRM": {"humanoid": {"humanBones": [{"bone": bone, "node": k + 1} for k, bone in enumerate(VRM)]}}}
VRM_1 = {"VRMC_vrm": {"humanoid": {"humanBones": {bone: {"node": k + 1} for k, bone in enumerate(VRM)}}}}
VRMA = {"VRMC_vrm_animation": VRM_1["VRMC_vrm"]}

FORMATS = {
    "Kimodo": (write_kimodo, 30),
    "Kimodo without its joints": (lambda f: write_kimodo(f, joints=False), 30),
    "GEM-X": (write_gemx, 30),
    "SOMA-X": (write_somax, 30),
    **{f"SAM 3D Body, {form}": (lambda f, form=form: write_sam3d(f, form), 30) for form in ("list", "dict", "folder")},
    **{f"SAM 3D Body, {form}": (lambda f, form=form: write_sam3d(f, form), 30) for form in ("npz", "json", "flipped")},
    "GLB of Blender": (lambda f: write_glb(f, MIXAMO), 25),
    "GLB with splines": (lambda f: write_glb(f, MIXAMO, method="CUBICSPLINE", scale=1.0), 25),
    "VRM 0": (lambda f: write_glb(f, BONES, VRM_0, "a.vrm"), 25),
    "VRM 1": (lambda f: write_glb(f, BONES, VRM_1, "a.vrm"), 25),
    "VRMA": (lambda f: write_glb(f, BONES, VRMA, "a.vrma"), 25),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_recorded_skeleton_gives_the_known_motion(tmp_path, name):
    write, fps = FORMATS[name]
    motion = load_motion(write(tmp_path), SKELETON)
    assert motion.fps == fps
    assert _worst_direction(motion) < POINTS
    assert _worst_rotation(motion) < ROLLS
    assert _path_off(motion) < 0.03


POSITIONS = {
    "joint positions": lambda f: _save(f, JOINTS[:, :22]),
    "of 24 joints": lambda f: _save(f, JOINTS),
    "in millimetres": lambda f: _save(f, 1000 * JOINTS[None, :, :22]),
    "MDM": lambda f: write_pickle(
        f / "results.pkl",
        {"motion": np.stack([JOINTS[:, :22].transpose(1, 2, 0)] * 2), "lengths": np.array([len(JOINTS)] * 2)},
    ),
    "HumanML3D": lambda f: _save(f, humanml_numbers(JOINTS[:, :22])),
    "HumanML3D, several": lambda f: _save(f, np.stack([humanml_numbers(JOINTS[:, :22])] * 3)),
}


def _save(folder, array):
    np.save(folder / "a.npy", array)
    return folder / "a.npy"


@pytest.mark.parametrize("name", POSITIONS)
def test_poses_are_fitted_to_positions(tmp_path, name):
    motion = load_motion(POSITIONS[name](tmp_path), SKELETON)
    assert motion.fps == 20
    notes = " ".join(motion.notes)
    assert "without rotations" in notes and "20 frames per second assumed" in notes
    assert ("the first is taken" in notes) == (name in ("MDM", "HumanML3D, several"))
    assert ("millimetres" in notes) == (name == "in millimetres")
    assert _worst_direction(motion) < POSITIONS_ALONE
    assert _path_off(motion) < 0.03


def test_humanml3ds_numbers_are_positions():
    recovered = humanml_positions(humanml_numbers(JOINTS[:, :22]))
    begin = JOINTS[0, 0] * [1, 0, 1]
    assert_allclose(recovered, JOINTS[:, :22] - begin, atol=1e-9)


def test_normalised_numbers_are_refused_with_the_way(tmp_path):
    numbers = humanml_numbers(JOINTS[:, :22])
    with pytest.raises(InputError, match=r"a\.npy: HumanML3D's 263 numbers: .* Std.npy and Mean.npy first"):
        load_motion(_save(tmp_path, (numbers - numbers.mean(0)) / (numbers.std(0) + 1)), SKELETON)
