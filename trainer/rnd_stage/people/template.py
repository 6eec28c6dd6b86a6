"""The unclothed template: the person of ``.person`` with SMPL's 24 joints, meshed evenly and skinned by heat."""

from __future__ import annotations

import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.motion.skeleton import smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES

from .person import JOINTS, person
from .remesh import Floats, Ints, mirror, remesh
from .solids import project, surface
from .weights import skinning_weights

MARCHING_STEP = 0.006  # m
REMESH_ROUNDS = 7


def rest_joints() -> Floats:
    """Joint positions [24, 3] m of the T-pose in SMPL's order."""
    sides = {f"right_{name[5:]}": (-x, y, z) for name, (x, y, z) in JOINTS.items() if name.startswith("left_")}
    return np.array([{**JOINTS, **sides}[name] for name in SMPL_NAMES], np.float64)


def edge_length(points: Floats) -> Floats:
    """Target edge length [N] m: 17.5 mm on the body, finer on face, hands and feet."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]

    def ramp(t: Floats) -> Floats:
        return np.clip(t, 0, 1)

    head = 0.0065 * ramp((y - 1.46) / 0.06) + 0.003 * ramp((y - 1.5) / 0.03) * ramp((z - 0.03) / 0.04)
    hand = 0.010 * ramp((x - 0.62) / 0.14)
    foot = 0.0065 * ramp((0.13 - y) / 0.06)
    return 0.0175 - np.maximum(head, np.maximum(hand, foot))


def template() -> tuple[Floats, Ints, Floats]:
    """Vertices [V, 3], faces [F, 3] and skinning weights [V, 24]; symmetric, watertight."""
    figure = person()
    half = surface(figure.distance, (0, -0.02, -0.16), (0.92, 1.78, 0.24), MARCHING_STEP)
    half = remesh(*half, edge_length, lambda points: project(figure.distance, points, 2), REMESH_ROUNDS)
    vertices, faces = mirror(*half)
    middle = np.interp(vertices[:, 1], [0.755, 0.80], [0.006, 0.03])  # pelvis blended, thighs not
    return vertices, faces, skinning_weights(vertices, faces, _bones(rest_joints()), list(SMPL_NAMES), middle)


def _bones(joints: Floats) -> list[tuple[int, Floats, Floats, float]]:
    """Capsules (joint, a, b, radius) of the bones, and of the trunk as wide as its ribs."""
    at = dict(zip(SMPL_NAMES, joints))
    bones = []

    def bone(name: str, a, b, radius: float) -> None:
        bones.append((SMPL_NAMES.index(name), np.array(a, float), np.array(b, float), radius))

    for name, y, half, z, radius in [
        ("pelvis", 0.930, 0.085, -0.010, 0.085),
        ("spine1", 1.080, 0.060, -0.005, 0.080),
        ("spine2", 1.205, 0.065, -0.004, 0.085),
        ("spine3", 1.320, 0.070, -0.010, 0.085),
    ]:
        bone(name, (-half, y, z), (half, y, z), radius)
    bone("neck", at["neck"], at["head"], 0.050)
    bone("head", at["head"] + [0, 0.03, 0.02], (0, 1.66, 0), 0.080)
    for side in ("left_", "right_"):
        sign = 1 if side == "left_" else -1
        chain = ["hip", "knee", "ankle", "foot"]
        for name, child, radius in zip(chain, chain[1:], (0.075, 0.050, 0.034)):
            bone(side + name, at[side + name], at[side + child], radius)
        bone(side + "ankle", at[side + "ankle"], (sign * 0.130, 0.035, -0.05), 0.03)
        bone(side + "foot", at[side + "foot"], (sign * 0.148, 0.018, 0.18), 0.02)
        bone(
            side + "collar",
            at[side + "collar"] + [sign * 0.04, 0.03, 0],
            at[side + "shoulder"] - [sign * 0.03, 0, 0],
            0.035,
        )
        chain = ["shoulder", "elbow", "wrist", "hand"]
        for name, child, radius in zip(chain, chain[1:], (0.042, 0.036, 0.022)):
            bone(side + name, at[side + name], at[side + child], radius)
        bone(side + "hand", at[side + "hand"], (sign * 0.870, 1.400, -0.016), 0.022)
    return bones


def template_body() -> Body:
    """The template as a ``Body``, rounded to 0.1 µm; takes 15 s."""
    vertices, faces, weights = template()
    rounded = vertices.astype(np.float32).astype(np.float64)
    skeleton = smpl_skeleton(rest_joints())
    return Body(rounded, faces.astype(np.int32), weights.astype(np.float32), skeleton, license="CC0-1.0")
