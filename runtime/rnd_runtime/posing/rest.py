"""Pose-independent data of an avatar, and the input of posing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats
from rnd_runtime.core.simd.vectors import WIDTH

from .skinning import (
    COMPONENTS,
    FACTORS,
    FLOOR,
    LIMBS,
    NEVER,
    NORMALS,
    POINTS,
    PosedArrays,
    bone_rows,
    node_fields,
    pose_kernel,
)

Floats32 = NDArray[np.float32]

_DEEPEST = 60.0  # max log ratio of a Gaussian's largest weight to its floor


class Template(NamedTuple):
    """Skinning weights relative to a Gaussian's largest: its floor, and the joints above it."""

    floors: Floats32  # [N]
    gaussians: NDArray[np.intp]  # [L] ascending
    joints: NDArray[np.intp]  # [L]
    logs: Floats32  # [L] log(weight − floor)


@dataclass(frozen=True, eq=False)
class RestPose:
    """Pose-independent data of an avatar.

    Attributes:
        neighbours: [N, K] nodes that a Gaussian is interpolated between.
        neighbour_weights: [N, K].
        log_template: [N, J] log of the template's skinning weights, up to a constant per Gaussian.
        points: [N, 3] m, x_c.
        factors: [N, 9] m, R S row by row.
        normals: [N, 3] unit.
        limbs: [N, 7] the limb's axis (unit), share · lever from it to the point (m), and the share of a limb (0…1).
        max_offset: m.
        floor: m², added to variances.
        fallback: weight of A_R in a normal.
    """

    neighbours: NDArray[np.int32]
    neighbour_weights: Floats32
    log_template: Floats32
    points: Floats32
    factors: Floats32
    normals: Floats32
    limbs: Floats32
    max_offset: float
    floor: float
    fallback: float

    def pose(
        self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike, bones: ArrayLike
    ) -> PosedArrays:
        """Pose all Gaussians.

        Args:
            logits: [M, J] Δ logits at the nodes; None for the template's skinning.
            offsets: [M, 6] Δx and Δr before tanh.
            visibility: [M, S] SH coefficients, S ≤ 16; missing ones are 0.
            bones: [J, 3, 4] m, rest pose → posed.
        """
        nodes = self.nodes(logits, offsets, visibility)
        posed: PosedArrays = pose_kernel(self.arrays, nodes, floats(bones), self.limits, len(self.points))
        return posed

    def node_fields(
        self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike, bones: ArrayLike
    ) -> Floats32:
        """Fields [M, 48 + C] that are interpolated between nodes.

        Σ_j e^(Δ_j − c) B_j row by row [12], Σ_j e^(Δ_j − c), c, 0, 0; offsets padded to 16; visibility [16]; Δ logits
        padded to C, a multiple of 16.
        """
        fields: Floats32 = node_fields(*self.nodes(logits, offsets, visibility), bone_rows(floats(bones)))
        return fields

    def nodes(
        self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike
    ) -> tuple[Floats32, Floats32, Floats32]:
        """Δ logits [M, J] (0 for None), offsets and visibility as kernels need them."""
        offsets = floats(offsets)
        changes = np.zeros((len(offsets), self.log_template.shape[1])) if logits is None else logits
        return floats(changes), offsets, floats(visibility)

    @cached_property
    def limits(self) -> tuple[np.float32, np.float32, np.float32]:
        """max_offset, floor and fallback."""
        return np.float32(self.max_offset), np.float32(self.floor), np.float32(self.fallback)

    @cached_property
    def template(self) -> Template:
        """The template as it is summed."""
        template_logs = np.asarray(self.log_template, np.float32)
        lowest = np.where(template_logs > -np.inf, template_logs, np.float32(np.inf)).min(1)
        gaussians, joints = np.nonzero(~(template_logs <= lowest[:, None]))  # NaN stays NaN
        log_ratios = template_logs[gaussians, joints].astype(np.float64) - lowest[gaussians]
        top = np.zeros(len(template_logs))
        with np.errstate(invalid="ignore"):
            np.maximum.at(top, gaussians, log_ratios)
            logs = log_ratios + np.log(-np.expm1(-log_ratios)) - top[gaussians]
        floors = np.exp(-np.minimum(top, _DEEPEST))
        return Template(floors.astype(np.float32), gaussians, joints, logs.astype(np.float32))

    @cached_property
    def arrays(self) -> RestArrays:
        """Kernel arrays."""
        count = len(self.points)
        padded = -(-count // WIDTH) * WIDTH
        components = np.zeros((padded, COMPONENTS), np.float32)
        floors = self.template.floors
        for first, values in (
            (POINTS, self.points),
            (FACTORS, self.factors),
            (NORMALS, self.normals),
            (LIMBS, self.limbs),
            (FLOOR, floors[:, None]),
        ):
            components[:count, first : first + values.shape[1]] = values
        neighbours = np.zeros((padded, self.neighbours.shape[1]), np.int32)
        weights = np.zeros(neighbours.shape, np.float32)
        neighbours[:count], weights[:count] = self.neighbours, self.neighbour_weights
        blocks = components.reshape(-1, WIDTH, COMPONENTS).transpose(0, 2, 1)
        return RestArrays(neighbours, weights, *_slots(self.template, padded), blocks.ravel())


def _slots(template: Template, padded: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats32]:
    """``starts``, ``joints`` and ``logs`` of ``RestArrays``."""
    _, gaussians, joints, logs = template
    counts = np.bincount(gaussians, minlength=padded)
    starts = np.concatenate([[0], np.cumsum(counts.reshape(-1, WIDTH).max(1))])
    slots = starts[gaussians // WIDTH] + np.arange(len(joints)) - (np.cumsum(counts) - counts)[gaussians]
    slot_joints = np.zeros((starts[-1], WIDTH), np.int32)
    slot_logs = np.full(slot_joints.shape, NEVER, np.float32)
    slot_joints[slots, gaussians % WIDTH], slot_logs[slots, gaussians % WIDTH] = joints, logs
    return starts.astype(np.int32), slot_joints.ravel(), slot_logs.ravel()


class RestArrays(NamedTuple):
    """Constants of a ``RestPose`` in reading order; N is padded to a multiple of 16.

    Sixteen Gaussians share a number of joint slots, since a number per Gaussian would mispredict branches; 2.5 of 24
    joints on average.
    """

    neighbours: NDArray[np.int32]  # [N, K]
    weights: Floats32  # [N, K]
    starts: NDArray[np.int32]  # [N/16 + 1]: slots of block i are starts[i] : starts[i + 1]
    joints: NDArray[np.int32]  # [S · 16], a joint of each of sixteen Gaussians per slot
    logs: Floats32  # [S · 16] ``Template.logs``
    components: Floats32  # [N/16 · 23 · 16] points, factors, normals, limbs, floors; blocks of sixteen by component


class Unposed(NamedTuple):
    """N unposed Gaussians: arguments of ``RestPose.pose`` for M nodes, and their material."""

    rest: RestPose
    logits: Floats32 | None  # [M, J]
    offsets: Floats32  # [M, 6]
    visibility: Floats32  # [M, S]
    bones: Floats32  # [J, 3, 4] m, rest pose → posed
    opacities: Floats32  # [N]
    albedo: Floats32  # [N, 3]
    roughness: Floats32  # [N]

    @property
    def root_rotation(self) -> Floats32:
        """[3, 3], root frame → frame of the bones."""
        return self.bones[0, :, :3]
