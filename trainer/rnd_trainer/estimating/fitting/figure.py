"""A parametric figure: a template body whose shape is linear in a few parameters.

Shape(β) = template + Σ_k β_k basis_k, for vertices and rest joints alike; every β_k has zero mean and unit deviation.
Any body with SMPL's joint names becomes a figure: lengths and girths follow from its skeleton and skinning weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES

Floats = NDArray[np.float64]

TEMPLATE = Path(__file__).with_name("figure.npz")
JOINTS = SMPL_NAMES[:22]
"""joints that a figure must have and that the fit moves"""
_SIDES = ("left_", "right_")

X, Y, Z, ACROSS, ALL = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1)
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")


def _both(*names: str) -> tuple[str, ...]:
    return tuple(side + name for name in names for side in _SIDES)


@dataclass(frozen=True)
class _Stretch:
    """One parameter: factors − 1 per unit, of bones (parent → joint) and of the flesh of joints, along X, Y, Z."""

    bones: tuple[tuple[tuple[str, ...], tuple[float, ...], float], ...] = ()
    flesh: tuple[tuple[tuple[str, ...], tuple[float, ...], float], ...] = ()


_LEG, _ARM = ("knee", "ankle"), ("elbow", "wrist")
_HAND = ("wrist", "hand", *(f"{f}{k}" for f in ("index", "middle", "pinky", "ring", "thumb") for k in "123"))
_SPINE = ("spine1", "spine2", "spine3", "neck", *_both("collar"))
# Deviations of adults' measures about those that the height explains: 3 to 6 % of lengths, 6 to 12 % of girths.
PARAMETERS: dict[str, _Stretch] = {
    "legs": _Stretch(((_both(*_LEG), Y, 0.035),), ((_both("hip", "knee"), Y, 0.035),)),
    "shins": _Stretch(
        ((_both("ankle"), Y, 0.03), (_both("knee"), Y, -0.03)), ((_both("knee"), Y, 0.03), (_both("hip"), Y, -0.03))
    ),
    "trunk": _Stretch(((_SPINE, Y, 0.04),), ((_TRUNK, Y, 0.04),)),
    "arms": _Stretch(((_both(*_ARM), X, 0.04),), ((_both("shoulder", "elbow"), X, 0.04),)),
    "forearms": _Stretch(
        ((_both("wrist"), X, 0.03), (_both("elbow"), X, -0.03)),
        ((_both("elbow"), X, 0.03), (_both("shoulder"), X, -0.03)),
    ),
    "shoulders": _Stretch(
        ((_both("collar", "shoulder"), X, 0.06),), ((_both("collar"), X, 0.06), (("spine3",), X, 0.06))
    ),
    "hips": _Stretch(((_both("hip"), X, 0.06),), ((("pelvis",), X, 0.06),)),
    "neck": _Stretch(((("head",), Y, 0.10),), ((("neck",), Y, 0.10),)),
    "head": _Stretch((), ((("head",), ALL, 0.05),)),
    "hands": _Stretch(((_both(*_HAND[1:]), ALL, 0.05),), ((_both(*_HAND), ALL, 0.05),)),
    "feet": _Stretch(((_both("foot"), Z, 0.05),), ((_both("ankle", "foot"), Z, 0.05),)),
    "chest depth": _Stretch((), ((("spine2", "spine3"), Z, 0.09),)),
    "waist": _Stretch((), ((("spine1", "spine2"), ACROSS, 0.08),)),
    "hip depth": _Stretch((), ((("pelvis",), Z, 0.10),)),
    "leg girth": _Stretch((), ((_both("hip", "knee"), ACROSS, 0.08),)),
    "arm girth": _Stretch((), ((_both("shoulder", "elbow"), (0, 1, 1), 0.10),)),
    "sex": _Stretch(  # a woman's difference from the mean
        ((_both("collar", "shoulder"), X, -0.05), (_both("hip"), X, 0.03)),
        (
            ((*_both("collar"), "spine3"), X, -0.05),
            (("spine3",), Z, -0.05),
            (("spine1", "spine2"), ACROSS, -0.05),
            (("pelvis",), X, 0.04),
            (_both("hip"), ACROSS, 0.03),
            (_both("shoulder", "elbow"), (0, 1, 1), -0.08),
            (("neck",), ACROSS, -0.08),
        ),
    ),
}
HEIGHT_DEVIATION = 0.055
CLOTHES_M, DRESSED_CLOTHES_M = 0.018, 0.010
"""mean thickness of clothes, m, over a naked body and over a known one, which may wear some already: the parameter
"clothes" is 0 there"""
CLOTHES_DEVIATION_M = 0.010
BUST_M = 0.014  # m, half of the difference of the sexes


@dataclass(frozen=True, eq=False)
class Figure:
    """A template and the basis of its shapes.

    Attributes:
        body: the template; β = 0.
        names: K parameters; none of a body whose shape is known.
        vertex_basis: [K, V, 3] m per unit.
        joint_basis: [K, J, 3] m per unit.
    """

    body: Body
    names: tuple[str, ...]
    vertex_basis: Floats
    joint_basis: Floats

    def shaped(self, shape: Floats) -> Body:
        """The body of the parameters ``shape`` [K]."""
        skeleton = self.body.skeleton
        rest = skeleton.rest_joints + np.tensordot(shape, self.joint_basis, 1)
        vertices = self.body.vertices + np.tensordot(shape, self.vertex_basis, 1)
        return replace(self.body, vertices=vertices, skeleton=Skeleton(skeleton.names, skeleton.parents, rest))

    def height(self, shape: Floats) -> float:
        """Height of the standing body, m; linear in ``shape``."""
        top, low = self.body.vertices[:, 1].argmax(), self.body.vertices[:, 1].argmin()
        here = self.body.vertices[[top, low], 1] + shape @ self.vertex_basis[:, [top, low], 1]
        return float(here[0] - here[1])


def known_figure(body: Body) -> Figure:
    """``body`` as it is, in clothes of unknown thickness."""
    check_joints(body)
    cover = _cover(body)
    dressed = replace(body, vertices=body.vertices + DRESSED_CLOTHES_M * cover)
    return Figure(dressed, ("clothes",), CLOTHES_DEVIATION_M * cover[None], np.zeros((1, len(body.skeleton), 3)))


def check_joints(body: Body) -> None:
    """Refuse a body that lacks SMPL's joints."""
    missing = [name for name in JOINTS if name not in body.skeleton.names]
    if missing:
        raise InputError("body", expected="SMPL's joint names", got=f"no {', '.join(missing[:4])}")


def figure_of(body: Body) -> Figure:
    """``body`` with all ``PARAMETERS``, its height and its clothes; β = 0 wears clothes of mean thickness."""
    check_joints(body)
    vertices, joints = body.vertices, body.skeleton.rest_joints
    names, flesh, bones = ["height"], [HEIGHT_DEVIATION * vertices], [HEIGHT_DEVIATION * joints]
    for name, stretch in PARAMETERS.items():
        moved, shifted = _stretched(body, stretch)
        names.append(name)
        flesh.append(moved + (_bust(body) if name == "sex" else 0.0))
        bones.append(shifted)
    cover = _cover(body)
    names.append("clothes")
    flesh.append(CLOTHES_DEVIATION_M * cover)
    bones.append(np.zeros_like(joints))
    dressed = replace(body, vertices=vertices + CLOTHES_M * cover)
    return Figure(dressed, tuple(names), np.stack(flesh), np.stack(bones))


@cache
def default_figure() -> Figure:
    """The figure that ships: MakeHuman's mean adult, phenotypes and all ``PARAMETERS`` but the sex, a phenotype too."""
    with Npz(TEMPLATE, what="figure") as archive:
        names = archive.strings("shape_names")
        flesh, bones = (archive.numbers(f"shape_{what}", (len(names), None, 3)) for what in ("vertices", "joints"))
    figure = figure_of(Body.load(TEMPLATE))
    kept = [k for k, name in enumerate(figure.names) if name != "sex"]
    return Figure(
        figure.body,
        (*(figure.names[k] for k in kept), *names),
        np.concatenate([figure.vertex_basis[kept], flesh.astype(np.float64)]),
        np.concatenate([figure.joint_basis[kept], bones.astype(np.float64)]),
    )


def _stretched(body: Body, stretch: _Stretch) -> tuple[Floats, Floats]:
    """Vertices' and joints' movement [V, 3], [J, 3] m per unit; soles stay where they are."""
    skeleton, rest = body.skeleton, body.skeleton.rest_joints
    index = {name: k for k, name in enumerate(skeleton.names)}
    lengthened, thickened = np.zeros((len(skeleton), 3)), np.zeros((len(skeleton), 3))
    for target, rows in ((lengthened, stretch.bones), (thickened, stretch.flesh)):
        for names, along, amount in rows:
            for name in names:
                if name in index:
                    target[index[name]] += amount * np.array(along, np.float64)
    joints = np.zeros_like(rest)
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            joints[joint] = joints[parent] + lengthened[joint] * (rest[joint] - rest[parent])
    weights = body.skinning_weights.astype(np.float64)
    # Σ w_j (shift_j + s_j (v − rest_j))
    moved = weights @ (joints - thickened * rest) + (weights @ thickened) * body.vertices
    soles = body.vertices[:, 1] < body.vertices[:, 1].min() + 0.02
    up = np.array([0.0, moved[soles, 1].mean(), 0.0])
    return moved - up, joints - up


def _bust(body: Body) -> Floats:
    """A woman's chest [V, 3] m, at the height of the shoulder blades' lower ends."""
    skeleton = body.skeleton
    at = dict(zip(skeleton.names, skeleton.rest_joints))
    y = 0.5 * (at["spine3"][1] + at["left_collar"][1]) - 0.07
    p = body.vertices
    front = np.clip((p[:, 2] - at["spine3"][2]) / 0.08, 0, 1)
    side = 0.42 * abs(at["left_shoulder"][0] - at["right_shoulder"][0]) / 2
    mounds = np.exp(-(((np.abs(p[:, 0]) - side) / 0.055) ** 2) - ((p[:, 1] - y) / 0.055) ** 2) * front
    return np.stack([0 * mounds, 0 * mounds, BUST_M * mounds], axis=1)


def vertex_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Unit normals [V, 3], weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _cover(body: Body) -> Floats:
    """Movement [V, 3] of the surface by a metre of clothes; none on head and hands."""
    names = body.skeleton.names
    bare = [k for k, name in enumerate(names) if name == "head" or name.endswith(_HAND)]
    covered = 1 - body.skinning_weights[:, bare].sum(1)
    return covered[:, None] * vertex_normals(body.vertices, body.faces)
