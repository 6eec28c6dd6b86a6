"""A rigged, textured character, and this project's .npz layout of one.

The .npz has ``vertices``, ``faces``, ``uv``, ``face_uv``, ``material``, ``material_names``, ``textures``, ``weights``,
``joint_names``, ``parents`` and ``joints``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image, srgb_to_linear
from rnd_runtime.core.npz import Npz

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_VERTICES = 60_000  # triangles are subdivided below half of it, to resolve textures


@dataclass(frozen=True, eq=False)
class Character:
    """A character, one texture coordinate per vertex.

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


def read_npz(path: Path) -> Character:
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
    """Triangles subdivided until the vertices resolve the textures."""
    while len(vertices) < MAX_VERTICES / 2:
        vertices, faces, values = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=values)
        material = np.repeat(material, 4)  # the four parts of a triangle are consecutive
    return vertices, faces, values, material


def sample_texture(pixels: NDArray[np.generic], uv: Floats) -> tuple[Floats, Floats]:
    """Linear albedo [N, 3] and opacity [N] of an 8- or 16-bit image at ``uv`` [N, 2] (v upwards, wrapping)."""
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
