"""Rigged, textured characters of other makers, brought to the stage: SMPL's joints, a T-pose, the stage's cloth.

Read are the project's own .npz layout (``vertices``, ``faces``, ``uv``, ``face_uv``, ``material``, ``material_names``,
``textures``, ``weights``, ``joint_names``, ``parents``, ``joints``) and skinned glTF (``.gltf``). Joints are known
by their usual names (Mixamo's, CMU's, SMPL's); others pass their weights to the nearest ancestor that is known.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image, srgb_to_linear
from rnd_runtime.core.npz import Npz
from rnd_runtime.motion.skeleton import SMPL_NAMES, bone_transforms, smpl_skeleton
from rnd_runtime.shading.light import REC709_LUMINANCE

from .cloth import Capsules, Drape
from .dressing import Dressed
from .garments import ramp
from .remesh import vertex_normals

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CLOTH = re.compile(r"suit|shirt|trouser|pant|dress|skirt|jean|cloth|coat|jacket|sweater|hood|top|bottom|robe", re.I)
UNWORN = re.compile(r"eye|brow|lash|hair|braid|short0|long0|bob0|pony|afro|teeth|tongue|high-poly|low-poly", re.I)
SKIN = re.compile(r"skin|body", re.I)
SHOES = re.compile(r"shoe|boot", re.I)
HAIR = re.compile(r"hair|braid|short0|long0|bob0|pony|afro", re.I)
ROUGHNESS = ((SKIN, 0.45), (SHOES, 0.40), (re.compile(r"eye", re.I), 0.35), (UNWORN, 0.52), (CLOTH, 0.80))
OVER, UNDER = 0.03, 0.01  # m that a cover may lie above, or below where it comes through
ASIDE = 0.012  # m from a point's normal to the covering vertex: the usual distance of these
SUNK = 0.012  # m that what is covered is sunk: cloth may move 7 mm inwards
RIM = (0.012, 0.03)  # m from what is bare over which it sinks
CLEAR = 0.5  # opacity below which a triangle of a hair card is left out
RADIUS, SLACK, GAP = 0.015, 0.035, 0.010  # of the cloth: m, share, m
MOST_VERTICES = 60_000  # before triangles are halved for the sake of their textures
WELD = 1e-5  # m
HEIGHTS = (0.4, 2.6)  # m that a person may be tall: others are in centimetres, or lie

# what a joint of SMPL is called elsewhere, left side; lower case, without "mixamorig:" and punctuation
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

# joints that a file may lack: their place follows from the bone before them, by a share of its length
_SPARE = {
    "left_hand": ("left_wrist", "left_elbow", 0.3),
    "right_hand": ("right_wrist", "right_elbow", 0.3),
    "left_foot": ("left_ankle", "left_knee", 0.0),
    "right_foot": ("right_ankle", "right_knee", 0.0),
    "spine3": ("spine2", "spine1", 0.8),
}


@dataclass(frozen=True, eq=False)
class Character:
    """What a file holds, one texture coordinate to a vertex.

    Attributes:
        vertices: [V, 3] m; faces: [F, 3]; weights: [V, J].
        albedo: [V, 3] linear; opacity: [V].
        material: [F] into ``materials``.
        joint_names, parents, joints: J of them, at rest, m.
    """

    vertices: Floats
    faces: Ints
    weights: Floats
    albedo: Floats
    opacity: Floats
    material: Ints
    materials: tuple[str, ...]
    joint_names: tuple[str, ...]
    parents: Ints
    joints: Floats


def load_character(path: Path) -> Dressed:
    """Read a character and make it ready for the stage.

    Its template is its own surface without hair, eyes and lashes: what lies under its clothes is not in the file.

    Raises:
        InputError: unreadable, or without the joints of a person.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        character = _read_npz(path)
    elif suffix in (".glb", ".gltf"):
        from .gltf import read_gltf

        character = read_gltf(path)
    else:
        raise InputError("--character", expected=".npz, .glb or .gltf", got=path.suffix or "no suffix", file=path)
    return dress_character(character, path)


def dress_character(character: Character, path: Path) -> Dressed:
    """Rename the joints, stand in a T-pose, weld, and give cloth its freedom."""
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
    """The vertices with skin below clothes and shoes, shoes below trousers, and the scalp below hair sunk a little.

    Makers cut clothes for the rest pose only; in others the skin would come through them.
    """

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


def _read_npz(path: Path) -> Character:
    with Npz(path, what="character") as archive:
        names = archive.strings("joint_names")
        vertices = archive.numbers("vertices", (None, 3))
        faces = archive.numbers("faces", (None, 3)).astype(np.int64)
        uv = archive.numbers("uv", (None, 2))
        face_uv = archive.numbers("face_uv", (len(faces), 3)).astype(np.int64)
        material = archive.numbers("material", (len(faces),)).astype(np.int64)
        materials, textures = archive.strings("material_names"), archive.strings("textures")
        weights = archive.numbers("weights", (len(vertices), len(names)))
        parents = archive.numbers("parents", (len(names),)).astype(np.int64)
        joints = archive.numbers("joints", (len(names), 3))
    for what, index, limit in (
        ("faces", faces, len(vertices)),
        ("face_uv", face_uv, len(uv)),
        ("material", material, min(len(materials), len(textures))),
    ):
        if len(index) and not 0 <= index.min() <= index.max() < limit:
            raise InputError(what, expected=f"indices below {limit}", got=int(index.max()), file=path)
    corners = np.stack([faces.ravel(), face_uv.ravel(), np.repeat(material, 3)], axis=1)
    split, index = np.unique(corners, axis=0, return_inverse=True)
    arrays = _finer(
        vertices[split[:, 0]], index.reshape(-1, 3), {"uv": uv[split[:, 1]], "weights": weights[split[:, 0]]}, material
    )
    points, triangles, values, material = arrays
    albedo, opacity = np.full((len(points), 3), 0.5), np.ones(len(points))
    for number, texture in enumerate(textures):
        here = np.unique(triangles[material == number])
        if len(here):
            albedo[here], opacity[here] = sample_texture(read_image(path.parent / texture), values["uv"][here])
    return Character(points, triangles, values["weights"], albedo, opacity, material, materials, names, parents, joints)


def _finer(
    vertices: Floats, faces: Ints, values: dict[str, Floats], material: Ints
) -> tuple[Floats, Ints, dict[str, Floats], Ints]:
    """Triangles cut in four until there are vertices enough to hold the textures."""
    while len(vertices) < MOST_VERTICES / 2:
        vertices, faces, values = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=values)
        material = np.repeat(material, 4)  # the four parts of a triangle follow each other
    return vertices, faces, values, material


def sample_texture(pixels: NDArray[np.generic], uv: Floats) -> tuple[Floats, Floats]:
    """Linear albedo [N, 3] and opacity [N] of an 8- or 16-bit picture at ``uv`` [N, 2] (v upwards, wrapping)."""
    full = 255.0 if pixels.dtype == np.uint8 else 65535.0
    values = pixels.astype(np.float64) / full
    if values.shape[2] < 3:
        values = np.concatenate([np.repeat(values[..., :1], 3, axis=2), values[..., 1:]], axis=2)
    height, width = values.shape[:2]
    column, row = np.mod(uv[:, 0], 1) * width - 0.5, np.mod(1 - uv[:, 1], 1) * height - 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    s, t = (column - left)[:, None], (row - top)[:, None]

    def at(rows: Ints, columns: Ints) -> Floats:
        return values[np.mod(rows, height), np.mod(columns, width)]

    mixed = (1 - t) * ((1 - s) * at(top, left) + s * at(top, left + 1))
    mixed += t * ((1 - s) * at(top + 1, left) + s * at(top + 1, left + 1))
    opacity = mixed[:, 3] if mixed.shape[1] > 3 else np.ones(len(mixed))
    return np.asarray(srgb_to_linear(mixed[:, :3]), np.float64), opacity


def _smpl_joints(character: Character, path: Path) -> tuple[Floats, Floats]:
    """[J, 24] ones where a joint of the file belongs to one of SMPL's, and SMPL's joints at rest [24, 3] m."""
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
    """What SMPL calls each of the file's joints ``plain`` (lower case, letters and digits)."""
    own = {name.replace("_", ""): name for name in SMPL_NAMES}
    if set(own) <= set(plain):
        return own
    known: dict[str, str] = {}
    for smpl, names in _ALIASES.items():
        for side in ("left", "right"):
            known |= {name.replace("left", side): smpl.replace("left", side) for name in names}
    if "lowerback" in plain:  # CMU's spine begins with it, Mixamo counts from 0
        known |= {"spine": "spine2", "spine1": "spine3"}
    else:
        known |= {"spine": "spine1", "spine1": "spine2", "spine2": "spine3"}
    return known


def _t_pose(vertices: Floats, weights: Floats, joints: Floats) -> tuple[Floats, Floats]:
    """The character with straight, level arms and upright legs, which is what SMPL's poses start from."""
    skeleton = smpl_skeleton(joints)
    turns = np.tile(np.eye(3), (len(SMPL_NAMES), 1, 1))
    limbs = [("shoulder", "elbow", "arm"), ("elbow", "wrist", "arm"), ("hip", "knee", "leg"), ("knee", "ankle", "leg")]
    for side, sign in (("left_", 1.0), ("right_", -1.0)):
        carried = np.eye(3)
        for joint, child, limb in limbs:
            if joint == "hip":
                carried = np.eye(3)
            j, c = SMPL_NAMES.index(side + joint), SMPL_NAMES.index(side + child)
            wanted = np.array([sign, 0, 0]) if limb == "arm" else np.array([0.03 * sign, -1.0, 0])
            bone = carried @ (joints[c] - joints[j])
            turn = _between(bone, wanted)
            turns[j] = carried.T @ turn @ carried
            carried = turn @ carried
    bones = bone_transforms(skeleton, turns, np.zeros(3)).astype(np.float64)
    blend = np.tensordot(weights, bones, axes=1)
    posed = np.einsum("vij,vj->vi", blend[:, :, :3], vertices) + blend[:, :, 3]
    moved = skeleton.joint_transforms(turns, np.zeros(3))[:, :3, 3]
    floor = np.array([0.0, posed[:, 1].min(), 0.0])
    return posed - floor, moved - floor


def _between(a: Floats, b: Floats) -> Floats:
    """The smallest rotation [3, 3] that turns direction ``a`` into ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cross, cosine = np.cross(a, b), float(a @ b)
    x, y, z = cross
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / max(1 + cosine, 1e-6)


def _roughness(character: Character, of_vertex: Ints, colour: Floats) -> Floats:
    """By the material's name, a little lower where it is darker than its mean (worn, oily) and higher where paler."""
    base = np.array(
        [next((value for pattern, value in ROUGHNESS if pattern.search(name)), 0.7) for name in character.materials]
    )
    luminance = colour @ REC709_LUMINANCE
    mean = np.bincount(of_vertex, luminance, len(base)) / np.maximum(np.bincount(of_vertex, minlength=len(base)), 1)
    return np.clip(base[of_vertex] + 0.2 * (luminance - mean[of_vertex]), 0.25, 0.95)
