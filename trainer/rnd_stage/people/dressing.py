"""A dressed person: one closed surface over a template, its skinning, materials and cloth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.capture.body import Body
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_stage.cloth import Capsules, Cloth, Drape
from rnd_stage.render import Surface

from .garments import BOTTOM, HAIR, TOP, Garments, layers, ramp
from .paint import paint
from .remesh import adjacency, vertex_normals
from .solids import project, surface
from .subjects import PersonDesign
from .template import template_body

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Dressed:
    """A dressed person at rest.

    Attributes:
        body: the unclothed template.
        vertices: [V, 3] m; faces: [F, 3]; weights: [V, J] skinning.
        colour: [V, 3] linear albedo; roughness: [V].
        drape, capsules: parameters of the cloth.
    """

    body: Body
    vertices: Floats
    faces: Ints
    weights: Floats
    colour: Floats
    roughness: Floats
    drape: Drape
    capsules: Capsules


class Wearer:
    """A dressed person in motion; cloth is simulated once, from the first frame on, for all ``frames``."""

    def __init__(self, dressed: Dressed, motion: Motion, frames: list[int]) -> None:
        self.dressed, self.motion = dressed, motion
        last = max(frames) + 1
        self._bones = bone_transforms(dressed.body.skeleton, motion.rotations[:last], motion.translations[:last])
        normals = vertex_normals(dressed.vertices, dressed.faces)
        self._cloth = None
        if (dressed.drape.radius > 0).any():
            self._cloth = Cloth(dressed.vertices, normals, dressed.weights, dressed.drape, dressed.capsules)
            self._moves = self._cloth.simulate(self._bones, motion.fps, frames)

    def surface(self, frame: int) -> Surface:
        """The posed surface with cloth of one of ``frames``, in the world."""
        d = self.dressed
        blend = np.tensordot(d.weights, self._bones[frame].astype(np.float64), axes=1)
        vertices = np.einsum("vij,vj->vi", blend[:, :, :3], d.vertices) + blend[:, :, 3]
        if self._cloth is not None:
            vertices = self._cloth.displaced(vertices, self._moves[frame])
        return Surface(vertices, vertex_normals(vertices, d.faces), d.faces, d.colour, d.roughness)


def dress(subject: PersonDesign, step: float = 0.005, template: Body | None = None) -> Dressed:
    """Mesh, skin and paint ``subject`` with vertices ``step`` metres apart.

    Clothes are made on the template, by default ``template_body()``, and warped to the subject's shape with it.
    """
    garments, shape = subject.garments, subject.shape
    garments = replace(garments, shell=max(garments.shell, 1.7 * step))
    template = template_body() if template is None else template

    def whole(points: Floats) -> Floats:
        return layers(points, garments).min(axis=1)

    vertices, faces = surface(whole, (-0.93, -0.04, -0.34), (0.93, 1.82, 0.34), step)
    vertices = project(whole, vertices, 1)
    material = np.argmin(layers(vertices, garments), axis=1)
    normals = vertex_normals(vertices, faces)
    weights = transferred_weights(template, vertices, faces)
    weights = _hang_free(vertices, material, weights, garments)
    colour, roughness, relief = paint(vertices, material, garments, subject.palette)
    drape = _drape(template, vertices, normals, material, garments)

    vertices = shape.warp(vertices + relief[:, None] * normals)
    skeleton = smpl_skeleton(shape.warp(template.skeleton.rest_joints))
    body = Body(shape.warp(template.vertices), template.faces, template.skinning_weights, skeleton, "CC0-1.0")
    return Dressed(body, vertices, faces, weights, colour, roughness, drape, _leg_capsules(body, shape.limbs))


def _drape(body: Body, vertices: Floats, normals: Floats, material: Ints, garments: Garments) -> Drape:
    x, y = np.abs(vertices[:, 0]), vertices[:, 1]
    _, nearest = cKDTree(body.vertices).query(vertices)
    gap = np.sum((vertices - body.vertices[nearest]) * normals, axis=1)
    sleeve = 0.016 + 0.010 * ramp(x, 0.30, 0.60)
    trunk = 0.012 + 0.010 * ramp(y, 1.25, 1.05) + 0.022 * ramp(y, 1.05, 0.92)
    radius = np.where(x > 0.195, sleeve, trunk) * ramp(y, 1.455, 1.42)
    falls = np.zeros(len(y), bool)
    if garments.hem < 0.85:
        falls |= (material == TOP) & (y < 1.0) & (x < 0.5)
    if garments.cut == "skirt":
        falls |= (material == BOTTOM) & (y < 0.985)
    start = 1.0 if garments.hem < 0.85 else garments.hem - 0.02  # a skirt hangs from under the top's hem
    legs = 0.010 + 0.008 * ramp(y, 0.75, 0.55) + 0.016 * ramp(y, 0.42, 0.10)
    radius = np.where(material == BOTTOM, legs * ramp(y, 0.99, 0.95), np.where(material == TOP, radius, 0.0))
    radius = np.where(falls, 0.004 + 0.6 * np.maximum(start - y, 0), radius)
    if garments.hair in ("bob", "long"):
        radius = np.where(material == HAIR, 0.03 * ramp(y, 1.60, 1.50), radius)
    radius = np.where(radius < 1e-3, 0.0, radius)
    slack = np.where(material == HAIR, 0.0, np.where(falls, 0.01, 0.035 + 0.02 * ramp(x, 0.30, 0.5)))
    return Drape(radius, gap, slack, material, falls)


def _hang_free(vertices: Floats, material: Ints, weights: Floats, garments: Garments) -> Floats:
    """Weights with skirts bound to the pelvis and the thighs, smoothly across the middle, and hair to the head."""
    weights = weights.copy()
    x, y = vertices[:, 0], vertices[:, 1]
    pelvis, left, right, head = (SMPL_NAMES.index(n) for n in ("pelvis", "left_hip", "right_hip", "head"))
    falls = np.zeros(len(y), bool)
    if garments.hem < 0.85:
        falls |= (material == TOP) & (np.abs(x) < 0.5) & (y < 1.02)
    if garments.cut == "skirt":
        falls |= material == BOTTOM
    free = falls * ramp(y, 1.02, 0.88)
    goal = np.zeros_like(weights)
    thighs = 0.80 * ramp(y, 0.98, 0.80)
    side = ramp(x, -0.16, 0.16)
    goal[:, pelvis], goal[:, left], goal[:, right] = 1 - thighs, thighs * side, thighs * (1 - side)
    weights += free[:, None] * (goal - weights)
    hair = (material == HAIR) & (y < 1.60)
    weights[hair] = np.eye(weights.shape[1])[head]
    return weights


def _leg_capsules(body: Body, limbs: float) -> Capsules:
    joints = {name: body.skeleton.rest_joints[i] for i, name in enumerate(SMPL_NAMES)}
    numbers, ends, radii = [], [], []
    for side in ("left_", "right_"):
        for name, child, radius in (("hip", "knee", 0.088), ("knee", "ankle", 0.062)):
            numbers.append(SMPL_NAMES.index(side + name))
            ends.append([joints[side + name], joints[side + child]])
            radii.append(radius * limbs + 0.012)
    return Capsules(np.array(numbers), np.array(ends), np.array(radii))


def transferred_weights(body: Body, vertices: Floats, faces: Ints) -> Floats:
    """Skinning weights [V, 24] of the nearest template vertices of the same side, smoothed over the surface."""
    weights = np.zeros((len(vertices), len(body.skeleton)))
    for sign in (-1, 1):
        here = sign * vertices[:, 0] >= 0
        source = np.flatnonzero(sign * body.vertices[:, 0] >= -0.004)
        gap, index = cKDTree(body.vertices[source]).query(vertices[here], k=8)
        share = 1.0 / (gap + 0.004) ** 2
        share /= share.sum(axis=1, keepdims=True)
        weights[here] = np.einsum("vk,vkj->vj", share, body.skinning_weights[source[index]])
    neighbours = adjacency(faces, len(vertices))
    degree = neighbours.sum(axis=1)[:, None]
    for _ in range(12):
        weights = 0.5 * weights + 0.5 * (neighbours @ weights) / degree
    return weights / weights.sum(axis=1, keepdims=True)
