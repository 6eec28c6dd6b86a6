"""Widening of twisted limbs, which blend skinning shrinks (the "candy wrapper" artefact).

Two bones that share a point equally and differ by a twist θ shrink the limb's cross-section by cos θ/2. With u the
limb's axis and A the 3×3 part of the blend,

    t = |cof(A) u| / |A u|²  (area across the axis over the squared length along it, at most 1)

is 1 for rigid motion and bends in a plane through u, and cos² θ/2 under a twist. The factor is three Newton–Schulz
steps s → s (3 − s²)/2 on s = √t, divided by s: 2.8 at 150°, bounded by 27/8, smooth through 180°. In the rest pose it
scales a point's distance from the axis and a Gaussian's extent across it, and divides a normal's part across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.skinning import SMALLEST_SQUARE
from rnd_runtime.posing.skinning import TWIST_STEPS as STEPS

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TwistFrames:
    """Limb around each of N points of the rest pose."""

    axes: Tensor  # [N, 3] unit, along the limb, of either sign
    levers: Tensor  # [N, 3] m, from the limb's axis to the point, times ``shares``
    shares: Tensor  # [N] 0…1: 1 where the point's bones are collinear, 0 where no direction prevails


def twist_frames(points: Floats, weights: Floats, skeleton: Skeleton) -> tuple[Floats, Floats, Floats]:
    """Axes [N, 3], levers [N, 3] and shares [N] of ``TwistFrames``, from the template's skinning [N, J]."""
    bones = bone_axes(skeleton)
    outer = bones[:, :, None] * bones[:, None, :]
    values, vectors = np.linalg.eigh(np.einsum("nj,jrc->nrc", weights, outer))
    axes, shares = vectors[:, :, 2], np.clip(values[:, 2] - values[:, 1], 0, 1)
    across = np.eye(3) - outer
    origins = np.einsum("jrc,jc->jr", across, skeleton.rest_joints)
    levers = np.einsum("nrc,nc->nr", np.einsum("nj,jrc->nrc", weights, across), points) - weights @ origins
    levers -= axes * (axes * levers).sum(1, keepdims=True)
    return axes, shares[:, None] * levers, shares


def bone_axes(skeleton: Skeleton) -> Floats:
    """Unit directions [J, 3] of the joints' bones in the rest pose.

    Towards the child; of several, the straightest one (root: with most descendants). Leaves continue their parent.
    """
    joints, count = skeleton.rest_joints, len(skeleton)
    children: list[list[int]] = [[] for _ in range(count)]
    size = np.ones(count)
    for joint in range(count - 1, 0, -1):
        children[skeleton.parents[joint]].insert(0, joint)
        size[skeleton.parents[joint]] += size[joint]
    axes = np.tile([0.0, 1.0, 0.0], (count, 1))
    for joint in range(count):
        before = axes[skeleton.parents[joint]] if joint else None
        directions = [_unit(joints[child] - joints[joint]) for child in children[joint]]
        if before is not None:
            directions = [*sorted(directions, key=lambda d: -float(d @ before)), before]
        else:
            directions = [d for _, d in sorted(zip(-size[children[joint]], directions), key=lambda pair: pair[0])]
        axes[joint] = next((d for d in directions if d.any()), axes[joint])
    return axes


def widening(area: Tensor, length_squared: Tensor) -> Tensor:
    """Factor [N] ≥ 1 for the cross-section, from |cof(A) u| [N] and |A u|² [N]."""
    ratio = (area / length_squared.clamp(min=float(SMALLEST_SQUARE))).clamp(max=1)
    factor = torch.ones_like(ratio)
    for _ in range(STEPS):
        step = 0.5 * (3 - ratio)
        factor, ratio = factor * step, ratio * step * step
    return factor


def excess(linear: Tensor, cofactors: Tensor, frames: TwistFrames) -> Tensor:
    """κ [N] ≥ 0, the widening of the rest pose minus 1, without gradient; A and cof(A) are [N, 3, 3]."""
    axes = frames.axes[:, None, :]
    with torch.no_grad():
        area = (cofactors * axes).sum(-1).norm(dim=-1)
        length_squared = (linear * axes).sum(-1).square().sum(-1)
        return frames.shares * (widening(area, length_squared) - 1)


def _unit(vector: Floats) -> Floats:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else np.zeros(3)
