"""The dressed figure of the capture: loose garments over the template, their skinning and their folds.

Garments are the body's own distance field, offset and cut off at hems; the figure, its clothes and hair are meshed
as one closed surface. The template given to the trainer knows nothing of all this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_stage.people.dressing import transferred_weights
from rnd_stage.people.person import person
from rnd_stage.people.remesh import Floats, Ints, vertex_normals
from rnd_stage.people.solids import project, smooth_min, surface

SKIN, SHIRT, TROUSERS, SHOES, HAIR = range(5)
STEP = 0.005  # m between the dressed mesh's vertices; a pixel of the capture is 9 mm
LAG_SECONDS = 0.15  # cloth follows the joint angles through a first-order low-pass
TRAIL_SECONDS = 0.012  # delay of cloth behind the surface's velocity


@dataclass(frozen=True, eq=False)
class Dressed:
    """The dressed figure at rest.

    Attributes:
        vertices: [V, 3] m; faces: [F, 3]; weights: [V, 24] skinning weights.
        material: [V] one of SKIN … HAIR.
        looseness: [V] in [0, 1], how far the cloth trails behind.
    """

    vertices: Floats
    faces: Ints
    weights: Floats
    material: NDArray[np.int64]
    looseness: Floats


def ramp(value: Floats, start: float, end: float) -> Floats:
    """Smoothly from 0 at ``start`` to 1 at ``end``."""
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def neck_opening(points: Floats) -> Floats:
    """Distance [N] to the upright elliptic cylinder that cuts the shirt's collar."""
    across, along = points[:, 0] / 0.084, (points[:, 2] + 0.024) / 0.075
    return np.maximum(0.075 * (np.hypot(across, along) - 1.0), 1.39 - points[:, 1])


def layers(points: Floats) -> Floats:
    """Distances [N, 5] to skin, shirt, trousers, shoes and hair."""
    figure = person()
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    skin = figure.distance(points)

    covered = figure.distance(points, {"torso", "leg", "arm", "neck"})
    hanging = 0.013 * ramp(y, 1.18, 0.92) + 0.016 * np.exp(-(((y - 1.09) / 0.10) ** 2))  # past the waist
    loose = 0.011 + hanging * (x < 0.3) + 0.004 * ramp(x, 0.45, 0.63)
    shirt = covered - loose
    hem = 0.905 + 0.010 * np.cos(2 * np.arctan2(points[:, 0], z))
    for cut in (hem - y, x - 0.672, -neck_opening(points)):
        shirt = -smooth_min(-shirt, -cut, 0.006)

    legs = figure.distance(points, {"torso", "leg"})
    wide = 0.008 + 0.004 * ramp(y, 0.70, 0.50) + 0.015 * ramp(y, 0.42, 0.08)
    trousers = legs - wide
    for cut in (0.052 - 0.25 * (z + 0.02) - y, y - 1.03):
        trousers = -smooth_min(-trousers, -cut, 0.005)

    upper = figure.distance(points, {"foot", "leg"}) - 0.010
    upper = -smooth_min(-upper, 0.092 - y, 0.006)
    outline = figure.distance(np.stack([points[:, 0], np.full_like(y, 0.022), z], axis=1), {"foot"}) - 0.014
    sole = -smooth_min(-outline, -(np.abs(y - 0.004) - 0.017), 0.006)
    shoes = smooth_min(upper, sole, 0.004)
    return np.stack([skin, shirt, trousers, shoes, _hair(points)], axis=1)


def dress(body: Body) -> Dressed:
    """Mesh, skinning and materials of the dressed figure over ``body``."""

    def whole(points: Floats) -> Floats:
        return layers(points).min(axis=1)

    vertices, faces = surface(whole, (-0.93, -0.04, -0.18), (0.93, 1.80, 0.25), STEP)
    vertices = project(whole, vertices, 1)
    material = np.argmin(layers(vertices), axis=1)
    weights = transferred_weights(body, vertices, faces)
    x, y = np.abs(vertices[:, 0]), vertices[:, 1]
    hem = ramp(y, 1.10, 0.90) * (x < 0.3)
    looseness = np.where(material == SHIRT, np.maximum(0.15 + 0.85 * hem, 0.6 * ramp(x, 0.30, 0.60)), 0.0)
    looseness = np.where(material == TROUSERS, 0.2 + 0.5 * ramp(y, 0.40, 0.08), looseness)
    return Dressed(vertices, faces, weights, material, looseness)


class Wardrobe:
    """Poses a dressed figure along a motion, with folds that depend on pose and history."""

    def __init__(self, dressed: Dressed, body: Body, motion: Motion) -> None:
        self.dressed, self.body, self.motion = dressed, body, motion
        self.normals = vertex_normals(dressed.vertices, dressed.faces)
        angles = matrix_to_axis_angle(motion.rotations)
        keep = np.exp(-1.0 / (motion.fps * LAG_SECONDS))
        for frame in range(1, len(angles)):
            angles[frame] = keep * angles[frame - 1] + (1 - keep) * angles[frame]
        self.lagged = angles

    def posed(self, frame: int) -> tuple[Floats, Floats]:
        """Vertices [V, 3] m and unit normals [V, 3] of one frame, in the world."""
        skinned = self._skinned(frame)
        velocity = (skinned - self._skinned(max(frame - 3, 0))) * self.motion.fps / 3
        smooth = vertex_normals(skinned, self.dressed.faces)
        trail = -TRAIL_SECONDS * np.sum(velocity * smooth, axis=1) * self.dressed.looseness
        lift = self._folds(self.lagged[frame]) + np.clip(trail, -0.012, 0.012)
        vertices = skinned + lift[:, None] * smooth
        return vertices, vertex_normals(vertices, self.dressed.faces)

    def _skinned(self, frame: int) -> Floats:
        bones = bone_transforms(self.body.skeleton, self.motion.rotations[frame], self.motion.translations[frame])
        blended = np.tensordot(self.dressed.weights, bones.astype(np.float64), axes=1)
        return np.einsum("vij,vj->vi", blended[:, :, :3], self.dressed.vertices) + blended[:, :, 3]

    def _folds(self, angles: Floats) -> Floats:
        """Offset [V] m of the cloth from its rest shape, from the joints' delayed axis-angles [24, 3]."""
        p, normal = self.dressed.vertices, self.normals
        x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
        turn = {name: angles[i] for i, name in enumerate(SMPL_NAMES)}
        shirt = 0.0012 * np.sin(45 * y + 9 * np.sin(14 * p[:, 0])) * np.sin(38 * p[:, 0] + 17 * z + 8 * y)
        jeans = 0.0010 * np.sin(60 * y + 25 * p[:, 0] + 5 * np.sin(30 * z))
        for side, sign in (("left_", 1), ("right_", -1)):
            here = sign * p[:, 0] > 0
            bend = np.minimum(np.linalg.norm(turn[side + "elbow"]), 2.0)
            s = x - 0.448
            inside = 0.45 + 0.55 * np.clip(normal[:, 2], -0.5, 1)
            shirt += here * 0.0055 * bend * inside * np.exp(-((s / 0.085) ** 2)) * np.sin(175 * s + 20 * (y - 1.41))
            raised = np.linalg.norm(turn[side + "shoulder"] + turn[side + "collar"])
            reach = np.hypot(x - 0.135, y - 1.345)
            near = np.exp(-((reach / 0.11) ** 2)) - np.exp(-((reach / 0.06) ** 2))  # not where spokes would meet
            spokes = np.sin(6 * np.arctan2(y - 1.345, x - 0.135) + 40 * reach)
            shirt += here * 0.0060 * np.minimum(raised, 1.6) * near * spokes
            bend = np.minimum(np.linalg.norm(turn[side + "knee"]), 2.0)
            s = y - 0.49
            behind = 0.45 - 0.55 * np.clip(normal[:, 2], -1, 0.5)
            jeans += here * 0.0060 * bend * behind * np.exp(-((s / 0.10) ** 2)) * np.sin(125 * s + 25 * (x - 0.11))
            flexed = np.clip(-turn[side + "hip"][0], 0, 1.6)
            s = y - 0.87 + 0.35 * (x - 0.09)
            front = np.clip(normal[:, 2] + 0.2, 0, 1)
            jeans += here * 0.0065 * flexed * front * np.exp(-((s / 0.07) ** 2)) * np.sin(135 * s)
            s = y - 0.12
            jeans += here * (0.0015 + 0.001 * bend) * np.exp(-((s / 0.09) ** 2)) * np.sin(115 * s + 18 * z)
        trunk = turn["spine1"] + turn["spine2"] + turn["spine3"]
        waist = np.exp(-(((y - 1.07) / 0.12) ** 2)) * (x < 0.25)
        front = np.clip(0.35 + 0.65 * np.sign(trunk[0]) * normal[:, 2], 0, 1)
        shirt += waist * 0.0075 * min(abs(trunk[0]), 0.9) * front * np.sin(110 * y + 6 * np.sin(9 * p[:, 0]))
        about = np.arctan2(p[:, 0], z)
        shirt += waist * 0.0070 * trunk[1] * np.sin(60 * y + 3 * about)
        side = np.clip(0.3 - np.sign(trunk[2]) * normal[:, 0], 0, 1)
        shirt += waist * 0.0080 * min(abs(trunk[2]), 0.8) * side * np.sin(120 * y)
        cloth = self.dressed.material
        return np.where(cloth == SHIRT, shirt, np.where(cloth == TROUSERS, jeans, 0.0))


def _hair(points: Floats) -> Floats:
    x, y, z = points.T
    skull = person().distance(points, {"head"})
    crown = ramp(y, 1.62, 1.74)
    strands = 0.0035 * np.sin(95 * x + 30 * np.sin(25 * z)) * np.cos(70 * z + 40 * y) * crown
    cap = skull - (0.009 + 0.015 * crown + 0.006 * ramp(z, 0.05, 0.09) * crown) - strands
    line = np.interp(
        z, [-0.11, -0.08, -0.045, -0.012, 0.012, 0.035, 0.062, 0.10], [1.54, 1.55, 1.58, 1.655, 1.64, 1.668, 1.70, 1.71]
    )
    line = line + 0.006 * np.sin(120 * x + 2.0) * (z > 0.03)  # an uneven fringe
    return -smooth_min(-cap, -0.8 * (line - y), 0.010)
