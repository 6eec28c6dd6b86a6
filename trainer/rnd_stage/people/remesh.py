"""Isotropic remeshing of half a symmetric body that is open along x = 0; vertices of that seam remain on it.

Source: Botsch and Kobbelt, "A remeshing approach to multiresolution modeling" (2004).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def remesh(
    vertices: Floats, faces: Ints, size: Callable[[Floats], Floats], project: Callable[[Floats], Floats], rounds: int
) -> tuple[Floats, Ints]:
    """Triangles with edges of about ``size(points)`` metres on the surface onto which ``project`` moves points."""
    for _ in range(rounds):
        mesh = _Mesh(vertices, faces, size(vertices))
        mesh.split()
        mesh.collapse()
        mesh.flip()
        vertices, faces = mesh.arrays()
        vertices = _slide(vertices, faces, project)
    return vertices, faces


def mirror(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Both halves of a mesh that is open at x = 0, welded there."""
    n, seam = len(vertices), vertices[:, 0] == 0.0
    mirrored = np.where(seam, np.arange(n), n + np.cumsum(~seam) - 1)
    return np.vstack([vertices, vertices[~seam] * [-1, 1, 1]]), np.vstack([faces, mirrored[faces[:, ::-1]]])


def vertex_normals(vertices: Floats, faces: Ints) -> Floats:
    """Unit normals [V, 3], face normals weighted by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.ravel(), np.repeat(face_normals[:, k], 3), minlength=len(vertices)) for k in range(3)],
        axis=1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def adjacency(faces: Ints, count: int):
    """Sparse [V, V] matrix with ones where two vertices share an edge."""
    i = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
    j = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
    matrix = coo_array((np.ones(len(i)), (i, j)), (count, count)).tocsr()
    matrix.data[:] = 1.0
    return matrix


def _slide(vertices: Floats, faces: Ints, project: Callable[[Floats], Floats]) -> Floats:
    """Tangential smoothing, then back onto the surface."""
    seam = vertices[:, 0] == 0.0
    neighbours = adjacency(faces, len(vertices))
    for _ in range(3):
        normals = vertex_normals(vertices, faces)
        normals[seam, 0] = 0
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        step = neighbours @ vertices / neighbours.sum(axis=1)[:, None] - vertices
        step -= np.sum(step * normals, axis=1, keepdims=True) * normals
        step[seam] *= [0.0, 0.5, 0.5]  # the seam has neighbours on one side only
        vertices = vertices + 0.6 * step
    vertices = project(vertices)
    vertices[seam, 0] = 0.0
    return vertices


class _Mesh:
    """Editable triangles, with the set of faces of every vertex."""

    def __init__(self, vertices: Floats, faces: Ints, sizes: Floats) -> None:
        self.points = list(vertices)
        self.sizes = list(sizes)
        self.seam = [bool(x) for x in vertices[:, 0] == 0.0]
        self.faces: list[Any] = [tuple(f) for f in faces.tolist()]  # (a, b, c), or None once it has collapsed
        self.around: list[set[int]] = [set() for _ in vertices]
        for i, face in enumerate(self.faces):
            for v in face:
                self.around[v].add(i)

    def split(self) -> None:
        """Split edges longer than 4/3 of the target length."""
        for a, b in self._edges():
            if self._length(a, b) <= 4 / 3 * self._size(a, b):
                continue
            middle = len(self.points)
            shared = self.around[a] & self.around[b]
            self.points.append(0.5 * (self.points[a] + self.points[b]))
            self.sizes.append(self._size(a, b))
            self.seam.append(len(shared) == 1)
            self.around.append(set())
            for i in shared:
                face = self.faces[i]
                self._replace(i, tuple(middle if v == b else v for v in face))
                self._append(tuple(middle if v == a else v for v in face))

    def collapse(self) -> None:
        """Collapse edges shorter than 4/5 of the target length where the mesh remains a manifold."""
        for a, b in sorted(self._edges(), key=lambda e: self._length(*e)):
            shared = self.around[a] & self.around[b]
            if not shared or self._length(a, b) >= 4 / 5 * self._size(a, b):
                continue
            if self.seam[b] and not self.seam[a]:
                a, b = b, a
            if self.seam[a] and self.seam[b] and len(shared) == 2:
                continue  # would pinch the seam
            if len(self._neighbours(a) & self._neighbours(b)) != len(shared):
                continue
            target = self.points[a] if self.seam[a] != self.seam[b] else 0.5 * (self.points[a] + self.points[b])
            if self._spoils(a, b, target) or self._spoils(b, a, target):
                continue
            for i in shared:
                self._replace(i, None)
            for i in list(self.around[b]):
                self._replace(i, tuple(a if v == b else v for v in self.faces[i]))
            self.points[a] = target

    def flip(self) -> None:
        """Flip edges where that brings the four vertices closer to six neighbours (four on the seam)."""
        for a, b in self._edges():
            shared = list(self.around[a] & self.around[b])
            if len(shared) != 2:
                continue
            first = self.faces[shared[0]]
            if first[(first.index(a) + 1) % 3] != b:
                shared.reverse()
                first = self.faces[shared[0]]
            if first[(first.index(a) + 1) % 3] != b:
                continue
            c = next(v for v in first if v not in (a, b))
            d = next(v for v in self.faces[shared[1]] if v not in (a, b))
            if d in self._neighbours(c):
                continue
            before = sum(abs(self._excess(v)) for v in (a, b, c, d))
            change = {a: -1, b: -1, c: 1, d: 1}
            after = sum(abs(self._excess(v) + change[v]) for v in (a, b, c, d))
            if after >= before or min(len(self.around[a]), len(self.around[b])) <= 3:
                continue
            normal = self._normal(first) + self._normal(self.faces[shared[1]])
            new = (c, a, d), (d, b, c)
            if min(self._normal(new[0]) @ normal, self._normal(new[1]) @ normal) <= 0:
                continue
            self._replace(shared[0], new[0])
            self._replace(shared[1], new[1])

    def arrays(self) -> tuple[Floats, Ints]:
        """Used vertices and their faces."""
        faces = np.array([f for f in self.faces if f is not None], np.int64)
        used, faces = np.unique(faces, return_inverse=True)
        return np.array(self.points)[used], faces.reshape(-1, 3)

    def _edges(self) -> list[tuple[int, int]]:
        return list({(min(p), max(p)) for f in self.faces if f for p in (f[:2], f[1:], (f[2], f[0]))})

    def _length(self, a: int, b: int) -> float:
        """Of an edge, to the nanometre: below that CPUs differ, and equal edges would be sorted by chance."""
        x, y, z = self.points[a] - self.points[b]
        return round((x * x + y * y + z * z) ** 0.5, 9)

    def _size(self, a: int, b: int) -> float:
        return 0.5 * (self.sizes[a] + self.sizes[b])

    def _neighbours(self, v: int) -> set[int]:
        return {w for i in self.around[v] for w in self.faces[i]} - {v}

    def _excess(self, v: int) -> int:
        return len(self._neighbours(v)) - (4 if self.seam[v] else 6)

    def _normal(self, face: Any) -> Floats:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (self.points[v] for v in face)
        bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        return np.array([by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx])

    def _spoils(self, moved: int, other: int, target: Floats) -> bool:
        """Whether moving one end of a collapsing edge to ``target`` inverts a face or makes an edge too long."""
        if any(np.linalg.norm(self.points[n] - target) > 4 / 3 * self._size(n, moved) for n in self._neighbours(moved)):
            return True
        old = self.points[moved]
        for i in self.around[moved] - self.around[other]:
            before = self._normal(self.faces[i])
            self.points[moved] = target
            after = self._normal(self.faces[i])
            self.points[moved] = old
            if before @ after <= 0.2 * np.linalg.norm(before) * np.linalg.norm(after):
                return True
        return False

    def _replace(self, i: int, face: tuple | None) -> None:
        for v in self.faces[i]:
            self.around[v].discard(i)
        self.faces[i] = face
        for v in face or ():
            self.around[v].add(i)

    def _append(self, face: tuple) -> None:
        self.faces.append(face)
        for v in face:
            self.around[v].add(len(self.faces) - 1)
