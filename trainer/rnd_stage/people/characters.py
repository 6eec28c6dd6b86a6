"""Rigged, textured characters on the stage: with SMPL's joints, in a T-pose, with simulated cloth.

Files are .npz (``.character``) or skinned glTF (``.gltf``). Joints are identified by their names (Mixamo's, CMU's,
SMPL's); the weights of others go to their nearest known ancestor.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.skeleton import bone_transforms, smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES
from rnd_runtime.shading.light import REC709_LUMINANCE
from rnd_stage.cloth import Capsules, Drape

from .character import Character, Floats, Ints, read_npz
from .dressing import Dressed
from .garments import ramp
from .gltf import read_gltf
from .remesh import vertex_normals

CLOTH = re.compile(r"suit|shirt|trouser|pant|dress|skirt|jean|cloth|coat|jacket|sweater|hood|top|bottom|robe", re.I)
UNWORN = re.compile(r"eye|brow|lash|hair|braid|short0|long0|bob0|pony|afro|teeth|tongue|high-poly|low-poly", re.I)
SKIN = re.compile(r"skin|body", re.I)
SHOES = re.compile(r"shoe|boot", re.I)
HAIR = re.compile(r"hair|braid|short0|long0|bob0|pony|afro", re.I)
ROUGHNESS = ((SKIN, 0.45), (SHOES, 0.40), (re.compile(r"eye", re.I), 0.35), (UNWORN, 0.52), (CLOTH, 0.80))
OVER, UNDER = 0.03, 0.01  # m; range of a cover above and below a covered point
ASIDE = 0.012  # m; largest distance of the covering vertex from the point's normal
SUNK = 0.012  # m by which covered skin is moved inwards; cloth may move 7 mm inwards
RIM = (0.012, 0.03)  # m from bare skin over which the displacement rises
CLEAR = 0.5  # opacity below which triangles are dropped
RADIUS, SLACK, GAP = 0.015, 0.035, 0.010  # of the cloth: m, share, m
WELD = 1e-5  # m
HEIGHTS = (0.4, 2.6)  # m

# other names of SMPL's joints, left side; lower case, without "mixamorig:" and punctuation
_ALIASES = {
    "pelvis": ("hips", "hip", "root"),
    "spine1": ("lowerback",),
    "spine2": ("chest",),
    "spine3": ("upperchest",),
    "neck": ("neck", "neck1"),
    "head": ("head",),
    "left_hip": ("leftupleg", "leftthigh", "lefthip"),
    "left_knee": ("leftleg", "leftshin", "leftknee"),
    "left_ankle": ("leftfoot", "leftankle"),
    "left_foot": ("lefttoebase", "lefttoe"),
    "left_collar": ("leftshoulder", "leftclavicle", "leftcollar"),
    "left_shoulder": ("leftarm", "leftupperarm"),
    "left_elbow": ("leftforearm", "leftlowerarm", "leftelbow"),
    "left_wrist": ("lefthand", "leftwrist"),
    "left_hand": ("leftfingerbase", "lefthandmiddle1", "lefthandindex1"),
}

# joints that may be missing: (parent, its parent, extrapolation by this share of the bone)
_SPARE = {
    "left_hand": ("left_wrist", "left_elbow", 0.3),
    "right_hand": ("right_wrist", "right_elbow", 0.3),
    "left_foot": ("left_ankle", "left_knee", 0.0),
    "right_foot": ("right_ankle", "right_knee", 0.0),
    "spine3": ("spine2", "spine1", 0.8),
}


def load_character(path: Path) -> Dressed:
    """Read a character and prepare it for the stage.

    Its template is its own surface without hair, eyes and lashes; the body under its clothes is unknown.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        character = read_npz(path)
    elif suffix in (".glb", ".gltf"):
        character = read_gltf(path)
    else:
        raise InputError("--character", expected=".npz, .glb or .gltf", got=path.suffix or "no suffix", file=path)
    return dress_character(character, path)


def dress_character(character: Character, path: Path) -> Dressed:
    """Map the joints to SMPL's, pose in a T-pose, weld vertices, and set up the cloth."""
    groups, joints = _smpl_joints(character, path)
    weights = character.weights @ groups
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    vertices, joints = _t_pose(character.vertices, weights, joints)

    height = float(np.ptp(vertices[:, 1]))
    low, high = HEIGHTS
    if not low <= height <= high:
        raise InputError(
            "height of the character", expected=f"{low:g} to {high:g} m along Y", got=f"{height:.3g}", file=path
        )
    shown = ~(character.opacity[character.faces] < CLEAR).all(axis=1)
    faces, material = character.faces[shown], character.material[shown]
    of_vertex = np.zeros(len(vertices), np.int64)
    of_vertex[faces.ravel()] = np.repeat(material, 3)
    keys = np.concatenate([np.round(vertices / WELD).astype(np.int64), of_vertex[:, None]], axis=1)
    used = np.unique(faces)
    _, first, inverse = np.unique(keys[used], axis=0, return_index=True, return_inverse=True)
    renumber = np.zeros(len(vertices), np.int64)
    renumber[used] = inverse.ravel()
    chosen = used[first]
    faces = renumber[faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    faces, material = faces[proper], material[proper]
    vertices, weights, of_vertex = vertices[chosen], weights[chosen], of_vertex[chosen]
    colour = np.clip(character.albedo[chosen], 0.03, 0.80)
    vertices = _tucked_in(vertices, faces, weights, of_vertex, character.materials)

    worn = np.array([not UNWORN.search(name) for name in character.materials])
    body_faces = faces[worn[material]] if worn[material].any() else faces
    kept, body_index = np.unique(body_faces, return_inverse=True)
    body = Body(
        vertices[kept],
        body_index.reshape(-1, 3).astype(np.int32),
        weights[kept].astype(np.float32),
        smpl_skeleton(joints),
    )
    cloth = np.array([bool(CLOTH.search(name)) and not UNWORN.search(name) for name in character.materials])
    free = cloth[of_vertex]
    drape = Drape(
        np.where(free, RADIUS, 0.0),
        np.full(len(free), GAP),
        np.full(len(free), SLACK),
        of_vertex,
        np.zeros(len(free), bool),
    )
    none = Capsules(np.zeros(0, np.int64), np.zeros((0, 2, 3)), np.zeros(0))
    return Dressed(body, vertices, faces, weights, colour, _roughness(character, of_vertex, colour), drape, none)


def _tucked_in(vertices: Floats, faces: Ints, weights: Floats, of_vertex: Ints, materials: tuple[str, ...]) -> Floats:
    """Vertices with covered skin, shoes and scalp moved inwards, so that they do not penetrate covers when posed."""

    def named(pattern: re.Pattern[str]) -> NDArray[np.bool_]:
        return np.array([bool(pattern.search(name)) for name in materials])[of_vertex]

    skin, shoes, hair = named(SKIN), named(SHOES), named(HAIR)
    worn = ~skin & ~named(UNWORN)
    head = weights[:, SMPL_NAMES.index("head")] > 0.5
    normals = vertex_normals(vertices, faces)
    covered = np.zeros(len(vertices), bool)
    for below, cover in ((skin, worn), (shoes, worn & ~shoes), (skin & head, hair)):
        if not (below.any() and cover.any()):
            continue
        _, nearest = cKDTree(vertices[cover]).query(vertices[below])
        apart = vertices[cover][nearest] - vertices[below]
        height = np.sum(apart * normals[below], axis=1)
        aside = np.linalg.norm(apart - height[:, None] * normals[below], axis=1)
        covered[below] |= (height > -UNDER) & (height < OVER) & (aside < ASIDE)
    bare = (skin | shoes) & ~covered
    if not (covered.any() and bare.any()):
        return vertices
    inside, _ = cKDTree(vertices[bare]).query(vertices[covered])
    sunk = vertices.copy()
    sunk[covered] -= SUNK * ramp(inside, *RIM)[:, None] * normals[covered]
    return sunk


def _smpl_joints(character: Character, path: Path) -> tuple[Floats, Floats]:
    """Assignment [J, 24] of the file's joints to SMPL's, and SMPL's joints at rest [24, 3] m."""
    plain = [re.sub(r"mixamorig|[^a-z0-9]", "", name.lower()) for name in character.joint_names]
    known = _known_names(plain)
    own = [SMPL_NAMES.index(known[name]) if name in known else -1 for name in plain]
    joints = np.full((len(SMPL_NAMES), 3), np.nan)
    for index, target in enumerate(own):
        if target >= 0 and np.isnan(joints[target, 0]):
            joints[target] = character.joints[index]
    missing = [SMPL_NAMES[k] for k in np.flatnonzero(np.isnan(joints[:, 0])) if SMPL_NAMES[k] not in _SPARE]
    if missing:
        raise InputError("joints of the character", expected="a person's", got=f"no {', '.join(missing)}", file=path)
    for name, (parent, before, share) in _SPARE.items():
        k, p, b = (SMPL_NAMES.index(n) for n in (name, parent, before))
        if np.isnan(joints[k, 0]):
            joints[k] = joints[p] + share * (joints[p] - joints[b])
    groups = np.zeros((len(own), len(SMPL_NAMES)))
    for index in range(len(own)):
        ancestor = index
        while ancestor >= 0 and own[ancestor] < 0:
            ancestor = int(character.parents[ancestor])
        groups[index, own[ancestor] if ancestor >= 0 else 0] = 1
    return groups, joints


def _known_names(plain: list[str]) -> dict[str, str]:
    """SMPL's names of joints ``plain`` (lower case, letters and digits)."""
    own = {name.replace("_", ""): name for name in SMPL_NAMES}
    if set(own) <= set(plain):
        return own
    known: dict[str, str] = {}
    for smpl, names in _ALIASES.items():
        for side in ("left", "right"):
            known |= {name.replace("left", side): smpl.replace("left", side) for name in names}
    if "lowerback" in plain:  # CMU; Mixamo's spine counts from 0
        known |= {"spine": "spine2", "spine1": "spine3"}
    else:
        known |= {"spine": "spine1", "spine1": "spine2", "spine2": "spine3"}
    return known


def _t_pose(vertices: Floats, weights: Floats, joints: Floats) -> tuple[Floats, Floats]:
    """Vertices and joints in SMPL's rest pose: straight, level arms and upright legs."""
    skeleton = smpl_skeleton(joints)
    rotations = np.tile(np.eye(3), (len(SMPL_NAMES), 1, 1))
    limbs = [("shoulder", "elbow", "arm"), ("elbow", "wrist", "arm"), ("hip", "knee", "leg"), ("knee", "ankle", "leg")]
    for side, sign in (("left_", 1.0), ("right_", -1.0)):
        carried = np.eye(3)
        for joint, child, limb in limbs:
            if joint == "hip":
                carried = np.eye(3)
            j, c = SMPL_NAMES.index(side + joint), SMPL_NAMES.index(side + child)
            wanted = np.array([sign, 0, 0]) if limb == "arm" else np.array([0.03 * sign, -1.0, 0])
            bone = carried @ (joints[c] - joints[j])
            rotation = _between(bone, wanted)
            rotations[j] = carried.T @ rotation @ carried
            carried = rotation @ carried
    bones = bone_transforms(skeleton, rotations, np.zeros(3)).astype(np.float64)
    blend = np.tensordot(weights, bones, axes=1)
    posed = np.einsum("vij,vj->vi", blend[:, :, :3], vertices) + blend[:, :, 3]
    moved = skeleton.joint_transforms(rotations, np.zeros(3))[:, :3, 3]
    floor = np.array([0.0, posed[:, 1].min(), 0.0])
    return posed - floor, moved - floor


def _between(a: Floats, b: Floats) -> Floats:
    """The smallest rotation [3, 3] that takes direction ``a`` to ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cross, cosine = np.cross(a, b), float(a @ b)
    x, y, z = cross
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / max(1 + cosine, 1e-6)


def _roughness(character: Character, of_vertex: Ints, colour: Floats) -> Floats:
    """Roughness by the material's name, lower where it is darker than its mean, higher where brighter."""
    base = np.array(
        [next((value for pattern, value in ROUGHNESS if pattern.search(name)), 0.7) for name in character.materials]
    )
    luminance = colour @ REC709_LUMINANCE
    mean = np.bincount(of_vertex, luminance, len(base)) / np.maximum(np.bincount(of_vertex, minlength=len(base)), 1)
    return np.clip(base[of_vertex] + 0.2 * (luminance - mean[of_vertex]), 0.25, 0.95)
