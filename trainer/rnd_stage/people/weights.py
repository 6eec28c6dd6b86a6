"""Smooth skinning weights by heat diffusion over the surface.

Source: Baran and Popović, "Automatic rigging and animation of 3D characters" (2007), section 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEGLIGIBLE = 0.01  # weights below this are dropped


def skinning_weights(
    vertices: Floats, faces: Ints, bones: list[tuple[int, Floats, Floats, float]], names: list[str], middle: Floats
) -> Floats:
    """Weights [V, J], rows summing to one.

    Args:
        bones: capsules (joint, end a [3], end b [3], radius m); distances are to their surfaces.
        middle: [V] m beyond the middle line at which the influence of the other side's joints ends.
    """
    gaps = np.stack([_segment_distance(vertices, a, b) - radius for _, a, b, radius in bones], axis=1)
    depths = np.stack([_segment_distance(vertices, a, b) for _, a, b, _ in bones], axis=1)
    joints = np.array([joint for joint, *_ in bones])
    side = np.array([1 if n.startswith("left_") else -1 if n.startswith("right_") else 0 for n in names])
    gaps[(side[joints][None, :] * vertices[:, :1]) < -1e-6] = np.inf
    nearest = np.argmin(gaps, axis=1)
    source = np.zeros((len(vertices), len(names)))
    source[np.arange(len(vertices)), joints[nearest]] = 1.0
    conductance = 1.0 / np.maximum(depths[np.arange(len(vertices)), nearest], 0.01) ** 2

    stiffness, area = _laplacian(vertices, faces)
    coupling = diags_array(conductance * area)
    weights = splu(csc_array(stiffness + coupling)).solve(coupling @ source)

    across = np.clip(0.5 + side[None, :] * vertices[:, :1] / (2 * middle[:, None]), 0, 1)
    weights *= across * across * (3 - 2 * across)
    weights /= weights.sum(axis=1, keepdims=True)
    weights = np.maximum(weights - NEGLIGIBLE, 0.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _segment_distance(points: Floats, a: Floats, b: Floats) -> Floats:
    t = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0, 1)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1)


def _laplacian(vertices: Floats, faces: Ints):
    """Cotangent stiffness [V, V] (positive semi-definite) and the area [V] of every vertex."""
    i, j, values = [], [], []
    for k in range(3):
        a, b, c = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        u, v = vertices[a] - vertices[c], vertices[b] - vertices[c]
        cotangent = np.sum(u * v, axis=1) / np.maximum(np.linalg.norm(np.cross(u, v), axis=1), 1e-12)
        i += [a, b, a, b]
        j += [b, a, a, b]
        values += [-cotangent / 2, -cotangent / 2, cotangent / 2, cotangent / 2]
    shape = (len(vertices), len(vertices))
    stiffness = coo_array((np.concatenate(values), (np.concatenate(i), np.concatenate(j))), shape).tocsc()
    p, q, r = (vertices[faces[:, k]] for k in range(3))
    thirds = np.linalg.norm(np.cross(q - p, r - p), axis=1) / 6
    return stiffness, np.bincount(faces.ravel(), np.repeat(thirds, 3), minlength=len(vertices))
