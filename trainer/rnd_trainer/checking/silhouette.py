"""Z-buffer of a posed mesh, for checks against masks and normal maps."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera

Floats = NDArray[np.float64]

NEAR = 0.05
"""near plane, m: triangles with a vertex in front of it are culled"""


class RenderedMesh(NamedTuple):
    """A mesh rasterised at the pixel centres of a camera."""

    mask: NDArray[np.bool_]  # [H, W] True where the mesh covers the pixel's centre
    normals: Floats  # [H, W, 3] unit face normals in OpenCV camera axes, z < 0; zero outside


def render_mesh(vertices: Floats, faces: NDArray[np.int32], camera: Camera, k1: float = 0.0) -> RenderedMesh:
    """Mask and normals of the mesh ``vertices`` [V, 3] (world, m), ``faces`` [F, 3].

    ``k1`` is a radial distortion in normalised coordinates: x (1 + k1 r²).
    """
    local, visible, nearest = _nearest_faces(vertices, faces, camera, k1)
    mask = nearest >= 0
    corners = local[visible]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cross /= np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-15)
    cross *= np.where((cross * corners[:, 0]).sum(1, keepdims=True) > 0, -1, 1)  # for either winding order
    normals = np.zeros((*mask.shape, 3))
    normals[mask] = cross[nearest[mask]]
    return RenderedMesh(mask, normals)


def silhouette(vertices: Floats, faces: NDArray[np.int32], camera: Camera, k1: float = 0.0) -> NDArray[np.bool_]:
    """The mask [H, W] of ``render_mesh`` alone."""
    mask: NDArray[np.bool_] = _nearest_faces(vertices, faces, camera, k1)[2] >= 0
    return mask


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks; 1 when both are empty."""
    union = int((a | b).sum())
    return 1.0 if union == 0 else int((a & b).sum()) / union


def _nearest_faces(
    vertices: Floats, faces: NDArray[np.int32], camera: Camera, k1: float
) -> tuple[Floats, NDArray[np.int32], NDArray[np.int64]]:
    """Vertices in camera axes, the faces in front of the camera, and the index [H, W] of the nearest of those."""
    local = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = local[:, :2] / depth[:, None]
        flat = flat * (1 + k1 * (flat**2).sum(1, keepdims=True))
        pixels = flat @ camera.K[:2, :2].T + camera.K[:2, 2]
    usable = (depth > NEAR) & np.isfinite(pixels).all(1) & (np.abs(pixels) < 1e6).all(1)
    visible = faces[usable[faces].all(1)]
    nearest = z_buffer(pixels, 1 / np.where(usable, depth, 1), visible, camera.width, camera.height)
    return local, visible, nearest


@numba.njit(cache=True, nogil=True)
def z_buffer(pixels, inverse_depth, faces, width, height):
    """Index [H, W] of the nearest face at each pixel centre, −1 without one."""
    nearest = np.full((height, width), -1, np.int64)
    depth = np.zeros((height, width))  # 1/z, linear in the image
    for f in range(faces.shape[0]):
        a, b, c = faces[f]
        ax, ay = pixels[a]
        bx, by = pixels[b]
        cx, cy = pixels[c]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        left = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        right = min(int(np.floor(max(ax, bx, cx) - 0.5)), width - 1)
        top = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        bottom = min(int(np.floor(max(ay, by, cy) - 0.5)), height - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = 1 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = u * inverse_depth[a] + v * inverse_depth[b] + w * inverse_depth[c]
                if z > depth[row, column]:
                    depth[row, column] = z
                    nearest[row, column] = f
    return nearest
