"""Float64 numpy reference of posing; the compiled pass (``skinning``) is tested against it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.shading.sh import SH_COUNT

from .rest import RestPose
from .skinning import SMALLEST_SQUARE, TWIST_STEPS

Floats = NDArray[np.float64]


def pose_reference(
    rest: RestPose, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike, bones: ArrayLike
) -> tuple[Floats, Floats, Floats, Floats]:
    """``RestPose.pose`` in float64."""
    offsets, visibility, bones = (np.asarray(a, np.float64) for a in (offsets, visibility, bones))
    weights = np.asarray(rest.neighbour_weights, np.float64)[..., None]
    logarithms = np.asarray(rest.log_template, np.float64)
    if logits is not None:
        logarithms = logarithms + (np.asarray(logits, np.float64)[rest.neighbours] * weights).sum(1)
    joint_weights = np.exp(logarithms - logarithms.max(1, keepdims=True))
    blend = np.einsum("nj,jrc->nrc", joint_weights / joint_weights.sum(1, keepdims=True), bones)
    linear = blend[:, :, :3]
    offset = np.tanh((offsets[rest.neighbours] * weights).sum(1))
    a, b, c = linear.transpose(1, 0, 2)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
    limbs = np.asarray(rest.limbs, np.float64)
    axes, levers = limbs[:, :3], limbs[:, 3:6]
    length = np.linalg.norm((linear @ axes[..., None])[..., 0], axis=1)
    area = np.linalg.norm((cofactors @ axes[..., None])[..., 0], axis=1)
    twist_ratio = np.minimum(area / np.maximum(length**2, SMALLEST_SQUARE), 1)
    factor = np.ones(len(twist_ratio))
    for _ in range(TWIST_STEPS):
        step = 0.5 * (3 - twist_ratio)
        factor, twist_ratio = factor * step, twist_ratio * step**2
    kappa = (limbs[:, 6] * (factor - 1))[:, None]
    points = rest.points + rest.max_offset * offset[:, :3] + kappa * levers
    means = (linear @ points[..., None])[..., 0] + blend[:, :, 3]

    s = 1 / np.sqrt(1 + (offset[:, 3:] ** 2).sum(1) / 4)
    x, y, z = (0.5 * offset[:, 3:] * s[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - s * z), 2 * (x * z + s * y)],
        [2 * (x * y + s * z), 1 - 2 * (x * x + z * z), 2 * (y * z - s * x)],
        [2 * (x * z - s * y), 2 * (y * z + s * x), 1 - 2 * (x * x + y * y)],
    ]
    factors = np.moveaxis(np.array(rows), 2, 0) @ np.asarray(rest.factors, np.float64).reshape(-1, 3, 3)
    outer = axes[:, :, None] * axes[:, None, :]
    factors = linear @ (factors + kappa[..., None] * (factors - outer @ factors))
    full = factors @ factors.transpose(0, 2, 1) + rest.floor * np.eye(3)
    mixed = cofactors + rest.fallback * linear
    normals = np.asarray(rest.normals, np.float64)
    normals = normals + kappa * axes * (axes * normals).sum(1, keepdims=True)
    normals = (mixed @ normals[..., None])[..., 0]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    visibility_posed = np.zeros((len(points), SH_COUNT))
    visibility_posed[:, : visibility.shape[1]] = (visibility[rest.neighbours] * weights).sum(1)
    return means, full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], normals, visibility_posed
