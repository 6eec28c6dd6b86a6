"""The same joint positions give the same pose, whatever the zero pose, the bones' axes and their rolls."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.readers.tree import MocapTree
from rnd_runtime.motion.retarget import Retargeted, retarget, retarget_tracks
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_runtime.motion.solving.directions import median_rotation
from rnd_runtime.motion.solving.solve import Tracks
from support.known_motion import FRAMES, MATRICES, PELVIS, SKELETON
from support.known_skeletons import assert_same_poses, degrees_apart, world_rotations
from support.paths import ASSETS, CASES
from support.zero_poses import MATCHED, random_rotations, rolled, tree, tree_of_world

REST = np.tile(np.eye(3), (24, 1, 1))
PAIRS = {
    "bones along X": ("bvh_bones_along_x/bones_along_x.bvh", "bvh_bones_along_x/world_aligned.bvh"),
    "bones along X, toes": ("bvh_bones_along_x/bones_along_x_toe.bvh", "bvh_bones_along_x/world_aligned.bvh"),
    "trunk rolled": ("bvh_trunk_rolled/hips_rolled.bvh", "bvh_trunk_rolled/world_aligned.bvh"),
    "root turned": ("bvh_root_not_trunk/root_turned.bvh", "bvh_root_not_trunk/root_upright.bvh"),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_joints_at_the_same_places_give_the_same_pose(pair):
    odd, plain = (load_motion(CASES / name, SKELETON) for name in PAIRS[pair])
    assert_same_poses(odd.rotations, plain.rotations)
    assert_allclose(odd.translations, plain.translations, atol=1e-3)
    assert odd.notes == plain.notes and not any("taken for up" in note for note in odd.notes)
    world = world_rotations(odd.rotations)[0]
    for joint in ("pelvis", "spine3", "head", "left_ankle", "right_ankle"):  # upright, soles down, toes ahead
        assert degrees_apart(world[SMPL_NAMES.index(joint)], np.eye(3)) < 10, joint


def walk() -> tuple[np.ndarray, np.ndarray, float]:
    motion = load_motion(ASSETS / "walk.npz", SKELETON)
    return motion.rotations[::3], (motion.translations + SKELETON.rest_joints[0])[::3], motion.fps / 3


@pytest.mark.parametrize("motion", ["known", "walk"])
def test_a_known_motion_comes_back_from_any_zero_pose(motion):
    rng = np.random.default_rng(5)
    rotations, pelvis, fps = (MATRICES, PELVIS, 30.0) if motion == "known" else walk()
    for _ in range(30 if motion == "known" else 4):
        found = retarget(tree(rotations, pelvis, random_rotations(rng, 24), fps=fps), SKELETON, MATCHED)
        assert_same_poses(found.rotations, rotations)
        assert_allclose(np.diff(found.translations, axis=0), np.diff(pelvis, axis=0), atol=2e-3)


def _knees_of_a_fit(waves: np.ndarray) -> dict[str, np.ndarray]:
    """Knees that bend about axes 20° aside on average, and as much to either side of it, as in fits of SMPL."""
    axes, bend, poses = np.radians(20 + 20 * waves), 0.7 + 0.4 * waves[::-1], {}
    for side, sign in (("left", -1), ("right", 1)):
        poses[f"{side}_hip"] = np.stack([0.4 * waves - 0.4, 0.15 * waves, 0 * waves], -1)
        poses[f"{side}_knee"] = bend[:, None] * np.stack([np.cos(axes), 0 * axes, sign * np.sin(axes)], -1)
    return poses


def _arms_that_twist(waves: np.ndarray) -> dict[str, np.ndarray]:
    """Arms held sideways that twist by ±126°, elbows bent by 17°."""
    still = np.zeros_like(waves)
    arms = {f"{side}_shoulder": np.stack([2.2 * waves, still, still], -1) for side in ("left", "right")}
    return arms | {"left_elbow": np.array([0, -0.3, 0]), "right_elbow": np.array([0, 0.3, 0])}


@pytest.mark.parametrize(("pose", "degrees"), [(_knees_of_a_fit, 8), (_arms_that_twist, 5)])
def test_a_walk_with_other_limbs_comes_back_from_any_zero_pose(pose, degrees):
    rotations, pelvis, fps = walk()
    rotations = rotations.copy()
    for name, vectors in pose(np.sin(np.arange(len(rotations)) * 0.9)).items():
        rotations[:, SMPL_NAMES.index(name)] = Rotation.from_rotvec(vectors).as_matrix()
    zero = random_rotations(np.random.default_rng(9), 24)
    found = retarget(tree(rotations, pelvis, zero, fps=fps), SKELETON, MATCHED)
    assert_same_poses(found.rotations, rotations, degrees=degrees)


@pytest.mark.parametrize("axes", ["xyz", "zxy", "yzx"])
def test_any_axis_may_be_up(axes):
    """The person stands: the trunk shows it, not the axes."""
    order = np.eye(3)[["xyz".index(axis) for axis in axes]]
    rotations, pelvis, fps = walk()
    rng = np.random.default_rng(1)
    zero = random_rotations(rng, 24)
    world = order @ world_rotations(rotations) @ np.swapaxes(zero, -1, -2)
    found = retarget(tree_of_world(world, pelvis @ order.T, zero, fps=fps), SKELETON, MATCHED)
    assert_same_poses(found.rotations, rotations)


@pytest.mark.parametrize("rolls", ["random", "drifting", "none at all"])
def test_rolls_that_a_program_made_up_are_not_followed(rolls):
    """Networks that know positions alone write any roll about a bone, another in every frame."""
    rotations, pelvis, fps = walk()
    rng, frames = np.random.default_rng(2), len(rotations)
    angles = {
        "random": rng.uniform(-3, 3, (frames, 24)),
        "drifting": np.cumsum(rng.normal(size=(frames, 24)), axis=0) * 0.4 + rng.uniform(-3, 3, 24),
    }
    points = SKELETON.joint_transforms(rotations, pelvis - SKELETON.rest_joints[0])[..., :3, 3]
    plain = retarget_tracks(Tracks({name: points[:, k] for name, k in MATCHED.items()}, fps=fps), SKELETON)
    if rolls == "none at all":
        found = plain
    else:
        found = retarget(
            tree_of_world(rolled(world_rotations(rotations), angles[rolls]), pelvis, REST, fps=fps), SKELETON, MATCHED
        )
    ends = [SMPL_NAMES.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("foot", "wrist", "hand")]
    expected = rotations.copy()
    expected[:, ends] = found.rotations[:, ends]  # which positions do not show
    assert_same_poses(found.rotations, expected, degrees=12.0)


def test_a_mirrored_recording_is_mirrored_back_with_a_note():
    """Left-handed axes: the left knee is where the right one was, and both bend backwards by the hips' left."""
    rotations, pelvis, fps = walk()
    points = SKELETON.joint_transforms(rotations, pelvis - SKELETON.rest_joints[0])[..., :3, 3]
    tracks = Tracks({name: points[:, k] * [-1, 1, 1] for name, k in MATCHED.items()}, fps=fps)
    plain = retarget_tracks(replace(tracks, points={name: points[:, k] for name, k in MATCHED.items()}), SKELETON)
    found = retarget_tracks(tracks, SKELETON)
    assert_allclose(found.rotations, plain.rotations, atol=1e-9)
    assert any("mirrored back" in note for note in found.notes)
    assert not any("mirrored" in note for note in plain.notes)


def _standing(ankle: float, spine_back: float) -> MocapTree:
    """Somebody who stands straight, with ankles ``ankle`` m higher and a spine that starts ``spine_back`` m behind."""
    rest = SKELETON.rest_joints.copy()
    rest[[SMPL_NAMES.index(f"{side}_ankle") for side in ("left", "right")], 1] += ankle
    rest[SMPL_NAMES.index("spine1")] -= [0, 0.07, spine_back]
    body = Skeleton(SKELETON.names, SKELETON.parents, rest)
    rotations, pelvis = np.tile(np.eye(3), (5, 24, 1, 1)), np.tile(rest[0], (5, 1))
    zero = random_rotations(np.random.default_rng(4), 24)
    return tree(rotations, pelvis, zero, body)


def test_joints_that_a_program_puts_elsewhere_do_not_bend_the_body():
    """Soles stay level and the trunk upright on a skeleton with high ankles and a spine from the back."""
    found = retarget(_standing(0.05, 0.04), SKELETON, MATCHED)
    world = world_rotations(found.rotations)[0]
    for joint in ("pelvis", "spine1", "spine3", "left_ankle", "right_ankle"):
        up = world[SMPL_NAMES.index(joint)] @ [0, 1, 0]
        assert np.degrees(np.arctan2(np.hypot(up[0], up[2]), up[1])) < 5, joint


def _with_fingers(known: MocapTree, zero: np.ndarray) -> MocapTree:
    """``known`` with an index and a little finger on the left hand."""
    wrist = SMPL_NAMES.index("left_wrist")
    fingers = np.array([[0.09, 0, 0.03], [0.08, 0, -0.03]]) @ zero[wrist].T
    still = np.tile(np.eye(3), (len(known.rotations), 2, 1, 1))
    return MocapTree(
        (*known.names, "LeftHandIndex1", "LeftHandPinky1"),
        (*known.parents, wrist, wrist),
        np.concatenate([known.offsets, fingers]),
        np.concatenate([known.rotations, still], 1),
        known.root_positions,
        known.fps,
    )


def test_knuckles_show_how_a_hand_is_held():
    """A palm turned up throughout the clip is no neutral one."""
    rotations, pelvis, fps = walk()
    wrist = SMPL_NAMES.index("left_wrist")
    rotations = rotations.copy()
    rotations[:, wrist] = Rotation.from_rotvec([1.3, 0, 0]).as_matrix()
    zero = random_rotations(np.random.default_rng(8), 24)
    known = tree(rotations, pelvis, zero, fps=fps)
    for file, near in ((_with_fingers(known, zero), True), (known, False)):
        found = retarget(file, SKELETON, MATCHED)
        apart = degrees_apart(world_rotations(found.rotations), world_rotations(rotations))[:, wrist]
        assert (apart.max() < 5) == near


def test_a_head_turned_throughout_the_clip_stays_so_where_the_zero_pose_is_a_persons():
    rotations, pelvis, fps = walk()
    head = SMPL_NAMES.index("head")
    rotations = rotations.copy()
    rotations[:, head] = Rotation.from_rotvec([0, 0.8, 0]).as_matrix()
    found = retarget(tree(rotations, pelvis, REST, fps=fps), SKELETON, MATCHED)
    assert_same_poses(found.rotations, rotations)


FEWER = {
    "no toes": {"left_foot", "right_foot"},
    "no neck": {"neck"},
    "no head and neck": {"head", "neck"},
    "no collars": {"left_collar", "right_collar"},
    "one spine": {"spine1", "spine2"},
    "no spine": {"spine1", "spine2", "spine3"},
    "legs alone": {name for name in SMPL_NAMES if not name.endswith(("_hip", "_knee", "_ankle", "_foot"))},
}


@pytest.mark.parametrize("lacking", FEWER)
def test_what_a_recording_lacks_leaves_the_rest_in_place(lacking):
    rotations, pelvis, fps = walk()
    matched = {name: joint for name, joint in MATCHED.items() if name not in FEWER[lacking]}
    zero = random_rotations(np.random.default_rng(3), 24)
    found: Retargeted = retarget(tree(rotations, pelvis, zero, fps=fps), SKELETON, matched)
    apart = degrees_apart(world_rotations(found.rotations), world_rotations(rotations)).max(0)
    for joint in ("left_hip", "right_knee", "left_ankle"):
        assert apart[SMPL_NAMES.index(joint)] < 12, joint
    resting = [name for name in SMPL_NAMES if name not in matched]
    assert f"joints that the motion lacks stay at rest: {', '.join(resting)}" in found.notes


@pytest.mark.parametrize("frames", [1, 2, FRAMES])
def test_few_frames_are_enough(frames):
    zero = random_rotations(np.random.default_rng(6), 24)
    found = retarget(tree(MATRICES[:frames], PELVIS[:frames], zero), SKELETON, MATCHED)
    plain = retarget(tree(MATRICES[:frames], PELVIS[:frames], REST), SKELETON, MATCHED)
    assert_same_poses(found.rotations, plain.rotations)


def test_rotations_that_are_no_numbers_have_a_median_that_is_none():
    rotations = np.tile(np.eye(3), (4, 1, 1))
    rotations[2] = np.inf
    assert np.isnan(median_rotation(rotations)).all()
