"""A plain z-buffer for textured meshes."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from rnd_runtime.core.camera import Camera


class Covered(NamedTuple):
    """Pixels [P] of an image that a mesh covers: where they are, their triangle's corners and the shares of these."""

    mask: np.ndarray  # [H, W] bool
    corners: np.ndarray  # [P, 3]
    shares: np.ndarray  # [P, 3] perspective-correct

    def of(self, values: np.ndarray) -> np.ndarray:
        """Vertex ``values`` [V, C] at the pixels [P, C]."""
        return np.einsum("pk,pkc->pc", self.shares, values[self.corners])


def rasterize(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> Covered:
    """What ``camera`` sees of a mesh in the world."""
    seen = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    face_of, shares = _z_buffer(pixels, seen[:, 2].copy(), faces.astype(np.int64), camera.height, camera.width)
    mask = face_of >= 0
    return Covered(mask, faces[face_of[mask]], shares[mask])


def sampled(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values [P, C] of ``image`` [S, S, C] at glTF's ``uv`` [P, 2], v down."""
    size = len(image)
    x, y = (uv * size - 0.5).T
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - column)[:, None], (y - row)[:, None]

    def at(r: np.ndarray, c: np.ndarray) -> np.ndarray:
        return image[np.clip(r, 0, size - 1), np.clip(c, 0, size - 1)].astype(float)

    top = at(row, column) * (1 - fx) + at(row, column + 1) * fx
    return top * (1 - fy) + (at(row + 1, column) * (1 - fx) + at(row + 1, column + 1) * fx) * fy


@numba.njit(cache=True)
def _z_buffer(pixels, depths, faces, height, width):
    face_of, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    shares = np.zeros((height, width, 3))
    for face in range(len(faces)):
        a, b, c = pixels[faces[face, 0]], pixels[faces[face, 1]], pixels[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        for row in range(max(int(min(a[1], b[1], c[1])) - 1, 0), min(int(max(a[1], b[1], c[1])) + 2, height)):
            for column in range(max(int(min(a[0], b[0], c[0])) - 1, 0), min(int(max(a[0], b[0], c[0])) + 2, width)):
                x, y = column + 0.5, row + 0.5
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                if u < 0 or v < 0 or u + v > 1:
                    continue
                over = u / depths[faces[face, 0]], v / depths[faces[face, 1]], (1 - u - v) / depths[faces[face, 2]]
                depth = 1 / (over[0] + over[1] + over[2])
                if depth < nearest[row, column]:
                    nearest[row, column], face_of[row, column] = depth, face
                    for k in range(3):
                        shares[row, column, k] = over[k] * depth
    return face_of, shares
