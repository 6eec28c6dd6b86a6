"""End sites show how heads, hands and feet are held; those that say nothing do not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rnd_runtime.motion.readers.bvh import read_bvh
from rnd_runtime.motion.retarget import Retargeted, retarget
from rnd_runtime.motion.smpl import SMPL_NAMES
from support.known_motion import FRAMES, MATRICES, PELVIS, SKELETON
from support.known_skeletons import NAMINGS, assert_same_poses, degrees_apart, world_rotations, write_bvh
from support.zero_poses import MATCHED, random_rotations, tree

REST = SKELETON.rest_joints
UP = np.array([0, 0.12, 0])


def _held(joint: str, vector: list[float]) -> np.ndarray:
    """The known motion with a joint held by a rotation vector over the clip."""
    rotations = MATRICES.copy()
    rotations[:, SMPL_NAMES.index(joint)] = Rotation.from_rotvec(vector).as_matrix()
    return rotations


def _retargeted(rotations: np.ndarray, ends: dict[str, np.ndarray], lacking: tuple[str, ...] = ()) -> Retargeted:
    """From a random zero pose; ``ends`` [3] m in the axes of our rest pose."""
    zero = random_rotations(np.random.default_rng(11), 24)
    offsets = {MATCHED[name]: zero[MATCHED[name]] @ end for name, end in ends.items()}
    known = replace(tree(rotations, PELVIS, zero), ends=offsets)
    used = tuple(k for k, name in enumerate(SMPL_NAMES) if name not in lacking)
    parents = [used.index(known.parents[k]) if known.parents[k] >= 0 else -1 for k in used]
    few = replace(
        known,
        names=tuple(known.names[k] for k in used),
        parents=tuple(parents),
        offsets=known.offsets[list(used)],
        rotations=known.rotations[:, list(used)],
        ends={used.index(k): end for k, end in offsets.items()},
    )
    return retarget(few, SKELETON, {SMPL_NAMES[k]: n for n, k in enumerate(used)})


def _apart(found: Retargeted, rotations: np.ndarray, joint: str) -> float:
    between = degrees_apart(world_rotations(found.rotations), world_rotations(rotations))
    return float(between[:, SMPL_NAMES.index(joint)].max())


@pytest.mark.parametrize(
    ("joint", "vector", "end"),
    [
        ("head", [0.9, 0, 0], UP),
        ("left_hand", [0, 0, 0.9], REST[SMPL_NAMES.index("left_hand")] - REST[SMPL_NAMES.index("left_wrist")]),
    ],
)
def test_what_is_held_throughout_the_clip_is_seen_by_its_end(joint, vector, end):
    rotations = _held(joint, vector)
    assert _apart(_retargeted(rotations, {joint: end}), rotations, joint) < 5
    assert _apart(_retargeted(rotations, {}), rotations, joint) > 30
    aside = np.linalg.norm(end) * np.array([0, 0, 1.0])  # a bone's own Y, which may be any
    assert _apart(_retargeted(rotations, {joint: aside}), rotations, joint) > 30


def test_ends_along_one_axis_of_bones_in_any_axes_say_nothing():
    """As programs write them that know no ends: "0 5 0" below each last joint."""
    zero = random_rotations(np.random.default_rng(2), 24)  # a toe's Y is where a toe may point
    known = tree(MATRICES, PELVIS, zero)
    ends = {MATCHED[name]: 0.05 * np.array([0, 1.0, 0]) for name in ("head", "left_foot", "right_foot")}
    plain, other = (retarget(one, SKELETON, MATCHED) for one in (known, replace(known, ends=ends)))
    assert_same_poses(other.rotations, plain.rotations, degrees=0.01)


def test_a_small_difference_is_where_a_program_puts_the_top_of_a_head():
    tilted = Rotation.from_rotvec([0.4, 0, 0]).as_matrix() @ UP
    plain, other = (_retargeted(MATRICES, ends) for ends in ({}, {"head": tilted}))
    assert_same_poses(other.rotations, plain.rotations, degrees=0.01)


def test_a_foot_without_toes_points_to_its_end():
    toes = ("left_foot", "right_foot")
    ends = {
        f"{side}_ankle": REST[MATCHED[f"{side}_foot"]] - REST[MATCHED[f"{side}_ankle"]] for side in ("left", "right")
    }
    rotations = MATRICES.copy()
    rotations[:, [MATCHED[name] for name in toes]] = np.eye(3)
    found = _retargeted(rotations, ends, toes)
    assert max(_apart(found, rotations, f"{side}_ankle") for side in ("left", "right")) < 5
    assert f"joints that the motion lacks stay at rest: {', '.join(toes)}" in found.notes
    upwards = _retargeted(rotations, dict.fromkeys(ends, UP), toes)
    nothing = _retargeted(rotations, {}, toes)
    assert_same_poses(upwards.rotations, nothing.rotations, degrees=0.01)


def test_bvh_has_them_by_joint(tmp_path):
    known = read_bvh(write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]))
    assert len(known.rotations) == FRAMES
    leaves = [k for k in range(24) if k not in known.parents]
    assert sorted(known.ends) == leaves
    assert all((end == [0, 0.05, 0]).all() for end in known.ends.values())
