"""Textures of a clothed surface, baked from the Gaussians around each texel.

Charts are xatlas'. A texel is what the player shows of its surroundings along the surface's normal: Gaussians blended
from the outside in. Normals are stored in MikkTSpace's tangent frames, which glTF's readers assume.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numba
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.playback.aov import ambient_visibility

from .surface import FACING, Surface, inverse_covariances

Floats = NDArray[np.float64]

NEIGHBOURS = 24  # Gaussians of a texel
CHUNK = 1 << 15  # texels at once
PADDING = 4  # texels between charts


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """A mesh with a vertex for each corner of a chart.

    Attributes:
        original: [C] vertex of the mesh. faces: [F, 3]. uv: [C, 2] in [0, 1], v up.
        tangents: [C, 4] unit, the bitangent's sign in the last.
    """

    original: NDArray[np.intp]
    faces: NDArray[np.int32]
    uv: Floats
    tangents: Floats


@dataclass(frozen=True, eq=False)
class Textures:
    """8-bit images [S, S, 3].

    Attributes:
        albedo: sRGB. normal: tangent space, (n + 1) / 2.
        material: occlusion, roughness and metallic, linear, as glTF packs them.
    """

    albedo: NDArray[np.uint8]
    normal: NDArray[np.uint8]
    material: NDArray[np.uint8]


def load_xatlas() -> ModuleType:
    """xatlas. Raises ``InputError`` where it or scipy is missing."""
    need_packages("mesh", "xatlas", "scipy", what="meshes need")
    import xatlas

    return xatlas


def unwrap(surface: Surface) -> Unwrapped:
    """Charts of ``surface``."""
    xatlas = load_xatlas()
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(surface.vertices.astype(np.float32), surface.faces.astype(np.uint32))
    packing.padding, packing.bilinear = PADDING, True
    atlas.generate(xatlas.ChartOptions(), packing)
    original, faces, uv = atlas[0]
    original, faces, uv = original.astype(np.intp), faces.astype(np.int32), uv.astype(np.float64)
    tangents = tangent_frames(surface.vertices[original], surface.normals[original], uv, faces)
    return Unwrapped(original, faces, uv, tangents)


def tangent_frames(vertices: Floats, normals: Floats, uv: Floats, faces: NDArray[np.int32]) -> Floats:
    """Tangents [V, 4] as MikkTSpace makes them: of the faces at a vertex, in its plane, weighted by their angles."""
    corners, coordinates = vertices[faces], uv[faces]
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    u1, v1 = (coordinates[:, 1] - coordinates[:, 0]).T
    u2, v2 = (coordinates[:, 2] - coordinates[:, 0]).T
    sign = np.where(u1 * v2 - u2 * v1 < 0, -1.0, 1.0)
    face_tangents = (v2[:, None] * along - v1[:, None] * across) * sign[:, None]
    tangents, signs = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        index = faces[:, corner]
        normal = normals[index]
        edges = [corners[:, (corner + k) % 3] - corners[:, corner] for k in (1, 2)]
        edges = [_unit(edge - (edge * normal).sum(1, keepdims=True) * normal) for edge in edges]
        angle = np.arccos(np.clip((edges[0] * edges[1]).sum(axis=1), -1, 1))
        tangent = _unit(face_tangents - (face_tangents * normal).sum(1, keepdims=True) * normal)
        np.add.at(tangents, index, angle[:, None] * tangent)
        np.add.at(signs, index, sign * angle)
    flat = np.linalg.norm(tangents, axis=1) < 1e-9
    tangents[flat] = np.cross(normals[flat], np.roll(normals[flat], 1, axis=1) * [1, -1, 1])
    return np.c_[_unit(tangents), np.where(signs < 0, -1.0, 1.0)]


def bake(surface: Surface, charts: Unwrapped, size: int) -> Textures:
    """Textures of ``size``² texels from the Gaussians of ``surface``."""
    from scipy.ndimage import distance_transform_edt

    face_of, inside = np.full((size, size), -1, np.int32), np.zeros((size, size, 3), np.float32)
    pixels = charts.uv * size
    _rasterize(np.c_[pixels[:, 0], size - pixels[:, 1]], charts.faces, face_of, inside)
    rows, columns = np.nonzero(face_of >= 0)
    if not len(rows):
        raise InputError("--texture", expected="a size that shows the mesh's faces", got=size)
    corners, shares = charts.faces[face_of[rows, columns]], inside[rows, columns].astype(np.float64)

    def at_texels(values: Floats) -> Floats:
        mean: Floats = np.einsum("tk,tkc->tc", shares, values[corners])
        return mean

    points, normals = at_texels(surface.vertices[charts.original]), at_texels(surface.normals[charts.original])
    material = _materials(points, _unit(normals), surface.gaussians)
    tangents = at_texels(charts.tangents[:, :3])
    bitangents = charts.tangents[corners[:, 0], 3:] * np.cross(normals, tangents)
    frames = np.stack([tangents, bitangents, normals], axis=-1)
    tangent_space = np.linalg.solve(frames, _unit(material[:, 3:6])[..., None])[..., 0]
    tangent_space[:, 2] = np.maximum(tangent_space[:, 2], 0.05)  # not behind the surface
    values = np.c_[linear_to_srgb(material[:, :3]), (_unit(tangent_space) + 1) / 2, material[:, 6:8]]
    _, (near_row, near_column) = distance_transform_edt(face_of < 0, return_indices=True)
    texels = np.zeros((size, size, values.shape[1]))
    texels[rows, columns] = values
    texels = to_bytes(texels[near_row, near_column])  # charts are continued beyond their outlines
    packed = np.dstack([texels[..., 7], texels[..., 6], np.zeros_like(texels[..., 0])])
    return Textures(texels[..., :3], texels[..., 3:6], packed)


def _materials(points: Floats, normals: Floats, gaussians: Gaussians) -> Floats:
    """Albedo, normal, roughness and ambient visibility [T, 8] at ``points`` [T, 3] m."""
    from scipy.spatial import cKDTree

    features = np.c_[gaussians.albedo, gaussians.normals, gaussians.roughness, ambient_visibility(gaussians)]
    precisions = inverse_covariances(gaussians)
    tree = cKDTree(gaussians.means)
    result = np.empty((len(points), features.shape[1]))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        _, near = tree.query(points[part], k=min(NEIGHBOURS, len(gaussians.means)))
        normal, offsets = normals[part], points[part][:, None] - gaussians.means[near]
        scaled = np.einsum("tkab,tkb->tka", precisions[near], offsets)
        across = np.einsum("tkab,tb->tka", precisions[near], normal)
        squared = (scaled * offsets).sum(-1)
        squared -= (across * offsets).sum(-1) ** 2 / np.einsum("tka,ta->tk", across, normal)
        facing = np.einsum("tc,tkc->tk", normal, gaussians.normals[near].astype(np.float64))
        alphas = np.minimum(gaussians.opacities[near] * np.exp(-0.5 * squared), 0.99)
        alphas *= np.clip((facing - FACING) / FACING, 1e-4, 1)
        front_first = np.argsort(np.einsum("tkc,tc->tk", offsets, normal), axis=1)
        alphas = np.take_along_axis(alphas, front_first, axis=1)
        weights = alphas * np.cumprod(np.c_[np.ones(len(alphas)), 1 - alphas[:, :-1]], axis=1)
        weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
        result[part] = np.einsum("tk,tkc->tc", weights, features[np.take_along_axis(near, front_first, axis=1)])
    return result


def _unit(vectors: NDArray[np.floating]) -> Floats:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Floats = vectors / np.where(lengths > 0, lengths, 1)
    return unit


@numba.njit(cache=True, error_model="numpy")
def _rasterize(pixels, faces, face_of, inside):
    """Fill ``face_of`` [S, S] and barycentric ``inside`` [S, S, 3] of triangles with corners ``pixels`` [V, 2]."""
    size = len(face_of)
    for face in range(len(faces)):
        a, b, c = pixels[faces[face, 0]], pixels[faces[face, 1]], pixels[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        top, bottom = max(int(min(a[1], b[1], c[1])) - 1, 0), min(int(max(a[1], b[1], c[1])) + 1, size - 1)
        left, right = max(int(min(a[0], b[0], c[0])) - 1, 0), min(int(max(a[0], b[0], c[0])) + 1, size - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                first = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                second = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                third = 1 - first - second
                if first >= 0 and second >= 0 and third >= 0:
                    face_of[row, column] = face
                    inside[row, column, 0], inside[row, column, 1], inside[row, column, 2] = first, second, third
