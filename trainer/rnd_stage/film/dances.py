"""Motions from joint-angle curves: a walking loop, the dance of the capture, and turning round in an A.

Angles are in degrees, given for the left side in anatomical terms and mirrored for the right. The walk's sagittal
curves are those of normal gait (hip 30° to −10°, knee 18° in stance and 60° in swing, ankle 10° to −18°). The body's
height follows from the lowest point of the soles.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_stage.people.remesh import Floats

FPS = 30.0
WALK_CYCLE = 33  # frames in two steps: 109 steps a minute
WALK_CYCLES = 4
TRAIN_SECONDS = 5.0
DANCE_SECONDS = 7.5  # the last third holds the novel poses
TURN = 400.0  # degrees
# per cent of the cycle from heel strike: hip flexion, knee flexion, ankle dorsiflexion, toe extension
GAIT = np.array(
    [
        (0, 27, 4, 0, 3),
        (8, 25, 12, -6, 0),
        (16, 19, 17, 0, 0),
        (26, 10, 13, 4, 0),
        (36, 0, 7, 8, 0),
        (44, -7, 6, 10, 3),
        (50, -10, 11, 9, 14),
        (56, -9, 25, 0, 27),
        (62, -3, 42, -16, 22),
        (70, 11, 59, -10, 6),
        (76, 21, 58, -3, 0),
        (84, 28, 36, 1, 0),
        (91, 29, 12, 2, 2),
        (96, 28, 3, 1, 3),
        (100, 27, 4, 0, 3),
    ],
    np.float64,
)

# seconds; each arm: raised above the horizontal, swept forward, swung forward when hanging, elbow, twist
ARMS = [
    (0.0, (-50, 0, 0, 12, 0), (-50, 0, 0, 12, 0)),
    (0.2, (-50, 0, 0, 12, 0), (-50, 0, 0, 12, 0)),
    (1.0, (10, 0, 0, 20, 0), (-68, 0, 20, 40, 0)),
    (1.5, (48, 0, 0, 30, 0), (-68, 0, -20, 30, 0)),
    (2.0, (0, 10, 0, 90, -75), (0, 10, 0, 90, -75)),
    (2.5, (-58, 0, 30, 80, 0), (-58, 0, 30, 80, 0)),
    (3.0, (-68, 0, -25, 20, 0), (48, 0, 0, 30, 0)),
    (3.5, (-12, 65, 0, 30, 0), (-12, 65, 0, 30, 0)),
    (4.0, (-42, 0, -10, 85, 35), (-42, 0, -10, 85, 35)),
    (4.5, (22, 0, 0, 12, 0), (22, 0, 0, 12, 0)),
    (5.0, (-50, 0, 0, 15, 0), (-50, 0, 0, 15, 0)),
    (5.5, (52, 20, 0, 60, -40), (-60, 0, 30, 90, 0)),
    (6.0, (-20, 45, 0, 95, 0), (30, 0, 0, 40, -60)),
    (6.5, (0, 0, 0, 8, 0), (-70, 0, 0, 12, 0)),
    (7.0, (-60, 0, 35, 95, 0), (55, 10, 0, 20, 0)),
    (7.5, (-50, 0, 0, 15, 0), (-50, 0, 0, 15, 0)),
]
# seconds; trunk: bent forward, twisted to the left, tilted to the right; crouch; left and right leg lifted
TRUNK = np.array(
    [
        (0.0, 0, 0, 0, 4, 0, 0),
        (0.4, 0, 0, 0, 4, 0, 0),
        (1.0, 5, 10, 8, 12, 0, 0),
        (1.5, 0, -10, 12, 5, 0, 40),
        (2.0, -6, 0, 0, 16, 0, 0),
        (2.5, 26, 0, 0, 36, 0, 0),
        (3.0, 5, -15, -12, 8, 45, 0),
        (3.5, 34, 0, 0, 20, 0, 0),
        (4.0, 5, 20, 0, 10, 0, 0),
        (4.5, -8, 0, 0, 5, 0, 0),
        (5.0, 0, 0, 0, 14, 0, 0),
        (5.5, 10, 20, 10, 10, 50, 0),
        (6.0, 0, -20, -10, 30, 0, 0),
        (6.5, 20, 10, -14, 8, 0, 30),
        (7.0, 0, 0, 12, 15, 0, 0),
        (7.5, 0, 0, 0, 4, 0, 0),
    ],
    np.float64,
)


def walk(skeleton: Skeleton) -> Motion:
    """Walking in place, facing +Z, periodic."""
    frames = WALK_CYCLE * WALK_CYCLES
    phase = np.arange(frames) / WALK_CYCLE
    slow = 2 * np.pi * np.arange(frames) / frames  # varies from cycle to cycle
    curve = CubicSpline(GAIT[:, 0] / 100, GAIT[:, 1:], bc_type="periodic")
    pose = _Pose(frames)
    for side, shift in (("left_", 0.0), ("right_", 0.5)):
        hip, knee, ankle, toes = curve((phase + shift) % 1.0).T
        pose.set(side + "hip", ("x", -hip), ("z", -2.8), ("y", 4))
        pose.set(side + "knee", ("x", knee))
        pose.set(side + "ankle", ("x", -ankle))
        pose.set(side + "foot", ("x", -toes))
        swing = -np.cos(2 * np.pi * (phase + shift) - 0.25)  # forward with the other leg
        pose.set(side + "collar", ("y", -3 * swing), ("z", -7))
        pose.set(side + "shoulder", ("x", -3 - 21 * swing - 2 * np.sin(slow)), ("z", -69), ("x", -8))
        pose.set(side + "elbow", ("y", -(26 + 13 * swing)))
        pose.set(side + "wrist", ("z", -6), ("y", -4))
    step = 2 * np.pi * phase
    pose.set("pelvis", ("y", -5 * np.cos(step)), ("z", 2.5 * np.sin(step + 0.4)), ("x", 3))
    pose.set("spine1", ("y", 3 * np.cos(step)), ("z", -2.0 * np.sin(step + 0.4)), ("x", 1 + np.cos(2 * step)))
    pose.set("spine2", ("y", 4 * np.cos(step)), ("z", -1.5 * np.sin(step + 0.4)), ("x", -1))
    pose.set("spine3", ("y", 4 * np.cos(step)), ("x", -2))
    pose.set("neck", ("y", -3 * np.cos(step)), ("x", 2))
    pose.set("head", ("y", -3 * np.cos(step) + 5 * np.sin(slow)), ("x", -2 - np.cos(2 * step)))
    sway = np.stack([0.018 * np.sin(step + 0.2), 0 * step, 0.008 * np.sin(2 * step)], axis=1)
    return _grounded(skeleton, pose.rotations, sway, periodic=True)


def dance(skeleton: Skeleton) -> Motion:
    """The capture's motion: an A-pose, then arms, bends and lifted knees while the person rotates in place."""
    times = np.arange(round(DANCE_SECONDS * FPS)) / FPS
    bend, twist, tilt, crouch, lift_left, lift_right = PchipInterpolator(TRUNK[:, 0], TRUNK[:, 1:])(times).T
    pose = _Pose(len(times))
    keys = np.array([key[0] for key in ARMS])
    crouch = crouch + 2.5 * (1 - np.cos(2 * np.pi * times / 0.5))  # a bounce on every beat
    for side, arm, lift, other in (("left_", 1, lift_left, lift_right), ("right_", 2, lift_right, lift_left)):
        raised, swept, swung, elbow, turned = PchipInterpolator(keys, np.array([k[arm] for k in ARMS]))(times).T
        shrug = 0.25 * raised
        pose.set(side + "collar", ("z", np.clip(shrug, -12, 14)), ("y", -0.15 * swept))
        raised = raised - np.clip(shrug, -12, 14)
        pose.set(side + "shoulder", ("x", -swung), ("y", -0.85 * swept), ("z", raised), ("x", turned))
        pose.set(side + "elbow", ("y", -elbow))
        pose.set(side + "wrist", ("z", -8 + 6 * np.sin(2 * np.pi * times / 0.9)), ("y", -0.06 * elbow))
        pose.set(side + "hip", ("x", -crouch - lift), ("z", 2 + 0.15 * crouch - 0.12 * other), ("y", 0.35 * crouch))
        pose.set(side + "knee", ("x", 2 * crouch + 1.5 * lift))
        pose.set(side + "ankle", ("x", -crouch + 0.5 * lift))
    share = {"spine1": 0.4, "spine2": 0.35, "spine3": 0.25}
    for name, part in share.items():
        pose.set(name, ("y", part * twist), ("z", -part * tilt), ("x", part * bend))
    pose.set("neck", ("x", -0.2 * bend), ("z", 0.2 * tilt))
    pose.set("head", ("x", -0.25 * bend), ("y", -0.4 * twist), ("z", 0.2 * tilt))
    lean = 0.10 * (lift_right - lift_left)
    turn = PchipInterpolator([0, TRAIN_SECONDS, DANCE_SECONDS], [0, TURN, TURN + 160])(times)
    pose.set("pelvis", ("y", turn), ("z", -lean), ("x", 0.12 * bend))
    across = 0.0016 * (lift_right - lift_left)  # weight over the standing leg
    heading = np.radians(turn)
    shift = np.stack([across * np.cos(heading), 0 * across, -across * np.sin(heading)], axis=1)
    return _grounded(skeleton, pose.rotations, shift, periodic=False)


def turn_round() -> Motion:
    """Turning round once in 5 s, arms in an A, with small steps, then on: what users are asked to film; 15 fps."""
    frames = np.arange(94)
    sway, step = np.sin(2 * np.pi * frames / 30), np.sin(2 * np.pi * frames / 18)
    angles, joint = np.zeros((len(frames), len(SMPL_NAMES), 3)), SMPL_NAMES.index  # rad, axis-angle
    angles[:, joint("pelvis"), 1] = 2 * np.pi * frames / 75
    for side, sign, lifted in (("left_", 1, np.maximum(step, 0)), ("right_", -1, np.maximum(-step, 0))):
        angles[:, joint(side + "shoulder"), 2] = 0.04 * sway - sign * 0.85
        angles[:, joint(side + "elbow"), 1] = -sign * 0.15
        angles[:, joint(side + "hip"), 0] = -0.25 * lifted
        angles[:, joint(side + "hip"), 2] = sign * 0.08
        angles[:, joint(side + "knee"), 0] = 0.45 * lifted
    angles[:, joint("spine1"), 0] = 0.03 + 0.02 * sway
    angles[:, joint("head"), 0] = 0.05
    return Motion(axis_angle_to_matrix(angles), np.zeros((len(frames), 3)), 15.0, SMPL_NAMES)


class _Pose:
    """Local rotations [F, 24, 3, 3], set joint by joint from rotations about the axes."""

    def __init__(self, frames: int) -> None:
        self.rotations = np.tile(np.eye(3), (frames, len(SMPL_NAMES), 1, 1))

    def set(self, name: str, *angles: tuple[str, Floats | float]) -> None:
        """Product, left to right, of rotations (axis, degrees); y and z change sign for right limbs."""
        total = np.eye(3)
        for axis, degrees in angles:
            vector = np.zeros((len(self.rotations), 3))
            sign = -1 if name.startswith("right_") and axis != "x" else 1
            vector[:, "xyz".index(axis)] = sign * np.radians(degrees)
            total = total @ axis_angle_to_matrix(vector)
        self.rotations[:, SMPL_NAMES.index(name)] = total


def _grounded(skeleton: Skeleton, rotations: Floats, shift: Floats, *, periodic: bool) -> Motion:
    """The motion with the root at heights at which the lowest point of the soles touches y = 0."""
    posed = skeleton.joint_transforms(rotations, shift)
    lowest = np.full(len(rotations), np.inf)
    for side, sign in (("left_", 1), ("right_", -1)):
        for joint, x, z in (("ankle", 0.130, -0.055), ("ankle", 0.145, 0.120), ("foot", 0.150, 0.175)):
            k = SMPL_NAMES.index(side + joint)
            offset = np.array([sign * x, 0.0, z]) - skeleton.rest_joints[k]
            lowest = np.minimum(lowest, (posed[:, k] @ [*offset, 1.0])[:, 1])
    height = gaussian_filter1d(-lowest, 0.8, mode="wrap" if periodic else "nearest")  # feet are soft
    translations = shift + height[:, None] * np.array([0.0, 1.0, 0.0])
    return Motion(rotations, translations, FPS, SMPL_NAMES)
