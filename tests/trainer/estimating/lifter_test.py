"""Lifting of landmarks: views, features, frame rates, and the shipped network on a known body."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_DIRECTIONS, REST_OFFSETS, Lifted
from rnd_trainer.estimating.lifter import CHANNELS, NETWORK, features, lift, looking_at
from rnd_trainer.estimating.observations import BLAZEPOSE, HAND_POINTS, GreyImages, Observations

SIZE = (480, 640)
FOCAL = 600.0
LIMBS = [
    JOINTS.index(n) - 1 for n in ("left_knee", "right_knee", "left_ankle", "right_ankle", "left_elbow", "right_elbow")
]
# m from a joint of the body, in the T-pose
BESIDE = {
    **dict.fromkeys(BLAZEPOSE[:11], ("head", (0.0, 0.06, 0.1))),
    "left_ear": ("head", (0.07, 0.07, 0.02)),
    "right_ear": ("head", (-0.07, 0.07, 0.02)),
    **dict.fromkeys(("left_pinky", "left_index", "left_thumb"), ("left_wrist", (0.08, 0.0, 0.0))),
    **dict.fromkeys(("right_pinky", "right_index", "right_thumb"), ("right_wrist", (-0.08, 0.0, 0.0))),
    **{f"{side}_heel": (f"{side}_ankle", (0.0, -0.05, -0.04)) for side in ("left", "right")},
    **{f"{side}_foot_index": (f"{side}_ankle", (0.0, -0.05, 0.15)) for side in ("left", "right")},
}


def _body(lowered: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks [33, 3] and directions [21, 3] in camera axes of a person 3.5 m away, arms lowered."""
    rotations = np.tile(np.eye(3), (22, 1, 1))
    for side, sign in (("left", -1), ("right", 1)):
        for part in ("shoulder", "elbow", "wrist"):
            rotations[JOINTS.index(f"{side}_{part}")] = axis_angle_to_matrix([0.0, 0.0, sign * lowered])
    joints = np.zeros((22, 3))
    for k, parent in enumerate(PARENTS[1:], 1):
        joints[k] = joints[parent] + rotations[parent] @ REST_OFFSETS[k]
    points = np.empty((33, 3))
    for k, name in enumerate(BLAZEPOSE):
        joint, offset = BESIDE.get(name, (name, (0.0, 0.0, 0.0)))
        points[k] = joints[JOINTS.index(joint)] + rotations[JOINTS.index(joint)] @ offset
    to_camera = np.diag([1.0, -1.0, -1.0]) @ axis_angle_to_matrix([0.0, yaw, 0.0])  # facing +Z is towards the camera
    directions = np.stack([rotations[p] @ d for p, d in zip(PARENTS[1:], REST_DIRECTIONS)])
    return points @ to_camera.T + [0, -0.1, 3.5], directions @ to_camera.T


def _observations(fps: float, count: int, yaws: np.ndarray, lowered: float = 0.9) -> tuple[Observations, np.ndarray]:
    points, directions = (np.stack(parts) for parts in zip(*(_body(lowered, yaw) for yaw in yaws)))
    pixels = points[..., :2] / points[..., 2:] * FOCAL + np.array(SIZE) / 2
    hips = points[:, [BLAZEPOSE.index("left_hip"), BLAZEPOSE.index("right_hip")]].mean(1, keepdims=True)
    seen = Observations(
        fps,
        SIZE,
        np.arange(count),
        pixels.astype(np.float32),
        np.full((count, 33), 0.98, np.float32),
        np.zeros((count, 33), np.float32),
        (points - hips).astype(np.float32),
        np.full((count, 2, HAND_POINTS, 2), np.nan, np.float32),
        np.zeros((count, 2), np.float32),
        GreyImages.of([np.zeros(SIZE[::-1], np.uint8)] * count, SIZE),
    )
    return seen, directions


def test_views_turn_the_persons_ray_onto_the_axis() -> None:
    middle = np.random.default_rng(0).normal(0, 0.5, (50, 2)).astype(np.float32)
    views = looking_at(middle)
    rays = np.concatenate([middle, np.ones((50, 1))], 1)
    turned = (views @ rays[..., None])[..., 0]
    np.testing.assert_allclose(turned[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(views @ np.swapaxes(views, 1, 2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-6)


def test_features_are_metres_whatever_the_image_scale() -> None:
    seen, _ = _observations(30, 20, np.full(20, 0.3))
    rays = (seen.keypoints_px - np.array(SIZE) / 2)[None] / FOCAL
    gap = np.zeros((1, 20), np.float32)
    near = features(rays, seen.confidence[None], seen.keypoints_m[None], gap).inputs
    far = features(rays / 2, seen.confidence[None], seen.keypoints_m[None], gap).inputs
    assert near.shape == (1, 20, CHANNELS)
    np.testing.assert_allclose(far[..., -2] - near[..., -2], np.log(2), atol=0.02)
    np.testing.assert_allclose(far[..., :50], near[..., :50], atol=0.08)


@pytest.mark.parametrize("fps", [10.0, 30.0, 60.0])
def test_the_shipped_network_finds_the_limbs_of_a_known_body(fps: float) -> None:
    assert NETWORK.stat().st_size < 8 << 20
    count = int(2 * fps)
    seen, directions = _observations(fps, count, np.linspace(-0.6, 0.9, count))
    lifted = lift(seen, FOCAL, (SIZE[0] / 2, SIZE[1] / 2))
    assert isinstance(lifted, Lifted) and len(lifted) == count
    np.testing.assert_allclose(np.linalg.norm(lifted.directions, axis=-1), 1, atol=1e-4)
    angle = np.degrees(np.arccos(np.clip((lifted.directions * directions).sum(-1), -1, 1)))[:, LIMBS]
    assert angle.mean() < 16
    assert (lifted.concentration > 0).all() and (lifted.roll_concentration > 0).all()


def test_unseen_limbs_are_less_certain() -> None:
    seen, _ = _observations(30, 60, np.full(60, 0.2))
    clear = lift(seen, FOCAL, (SIZE[0] / 2, SIZE[1] / 2))
    arm = [BLAZEPOSE.index(f"left_{n}") for n in ("elbow", "wrist", "pinky", "index", "thumb")]
    seen.confidence[:, arm] = 0.05
    hidden = lift(seen, FOCAL, (SIZE[0] / 2, SIZE[1] / 2))
    bone = JOINTS.index("left_wrist") - 1
    assert np.median(hidden.concentration[:, bone]) < np.median(clear.concentration[:, bone])


def test_one_frame_is_refused() -> None:
    seen, _ = _observations(30, 2, np.zeros(2))
    with pytest.raises(InputError, match="at least 2 frames"):
        lift(seen.select([0]), FOCAL, (240.0, 320.0))
