"""Keeping limbs round under twists, where blend skinning pinches them to a point (the "candy wrapper").

Two bones that share a point half and half and differ by a twist of θ about the limb shrink its cross-section by
cos θ/2: to a quarter at 150°. Here the cross-section is widened again by a factor that depends on how much of it
the blend has lost beyond what bending explains. With u the limb's axis and A the 3×3 part of the blend,

    t = |cof(A) u| / |A u|²  (area kept across the axis, over the square of the length kept along it; at most 1)

is 1 for every rigid motion and every bend in a plane through u, and cos² θ/2 under a twist. The factor is three
Newton–Schulz steps s → s (3 − s²)/2 on s = √t, divided by s: 2.8 at 150°, bounded by 27/8, smooth through
180°, where a blend that tries to decide for one side (a quaternion's) jumps. In the rest pose it stretches a point's
distance from the axis, a Gaussian's extent across it, and shrinks a normal's part across it.
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
    """The limb around each of N points of the rest pose.

    Attributes:
        axes: [N, 3] unit, along the limb; the sign means nothing.
        levers: [N, 3] m, from the limb's axis to the point, times ``shares``.
        shares: [N] 0…1, how much of a limb it is: 1 where the bones that hold the point are in line, 0 where
            none of their directions prevails.
    """

    axes: Tensor
    levers: Tensor
    shares: Tensor


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
    """Unit directions [J, 3] in which the joints' bones run in the rest pose.

    Towards the child; of several, the one straight ahead (from the root: the one that most joints hang on). A last
    joint goes on as its parent does.
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
        ways = [_unit(joints[child] - joints[joint]) for child in children[joint]]
        if before is not None:
            ways = [*sorted(ways, key=lambda way: -float(way @ before)), before]
        else:
            ways = [way for _, way in sorted(zip(-size[children[joint]], ways), key=lambda pair: pair[0])]
        axes[joint] = next((way for way in ways if way.any()), axes[joint])
    return axes


def widening(area: Tensor, length_squared: Tensor) -> Tensor:
    """Factor [N] ≥ 1 for the cross-section, from |cof(A) u| [N] and |A u|² [N]."""
    kept = (area / length_squared.clamp(min=float(SMALLEST_SQUARE))).clamp(max=1)
    factor = torch.ones_like(kept)
    for _ in range(STEPS):
        step = 0.5 * (3 - kept)
        factor, kept = factor * step, kept * step * step
    return factor


def excess(linear: Tensor, cofactors: Tensor, frames: TwistFrames) -> Tensor:
    """κ [N] ≥ 0, by how much the rest pose is to be widened; A and cof(A) are [N, 3, 3].

    Without gradient: it repairs a pose, and must not be used to explain a picture.
    """
    axes = frames.axes[:, None, :]
    with torch.no_grad():
        area = (cofactors * axes).sum(-1).norm(dim=-1)
        length_squared = (linear * axes).sum(-1).square().sum(-1)
        return frames.shares * (widening(area, length_squared) - 1)


def _unit(vector: Floats) -> Floats:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else np.zeros(3)
