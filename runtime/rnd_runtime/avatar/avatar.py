"""An ``avatar.onnx`` at work: its networks in onnxruntime, the rest of its posing in our kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import shallow_copy
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton, taken_along
from rnd_runtime.posing.levels import CULLED_LEVELS, MergedLevels, Surface, on_fewer_nodes
from rnd_runtime.posing.rest import RestPose, Unposed
from rnd_runtime.posing.window import moment
from rnd_runtime.shading.brdf import LARGEST_ALBEDO

from .file import REST_OUTPUTS
from .networks import Networks


class Detail(NamedTuple):
    """What there is of an avatar at a level of detail: mean distances of its Gaussians and of its nodes in m."""

    gaussians: int
    spacing: float
    node_spacing: float


class Encoded(NamedTuple):
    """The networks' outputs for one pose, for ``posed`` of the ``avatar``, at its level of detail, that encoded it.

    Posing happens in the root's frame, and camera and light are taken there: float32 resolves the body whatever its
    position in the world.
    """

    avatar: Avatar
    values: list[NDArray[np.float32]]  # node outputs: logits, unless skinning is static, offsets and visibility
    bones: NDArray[np.float32]  # [J, 3, 4] m, rest pose → this frame
    root: NDArray[np.float64]  # [4, 4] m, this frame → world
    seconds: dict[str, float]  # that "motion" and "encoders" took

    def in_world(self) -> Encoded:
        """The same, to be posed in the world."""
        return self._replace(bones=taken_along(self.bones, self.root), root=np.eye(4))

    def in_frame(self, frame: NDArray[np.float64]) -> Encoded:
        """The same, to be posed in another ``frame`` [4, 4] (frame → world, rigid, m)."""
        if np.array_equal(frame, self.root):
            return self
        return self._replace(bones=taken_along(self.bones, np.linalg.inv(frame) @ self.root), root=frame)


class Avatar:
    """An avatar read from ``avatar.onnx``, ready to be posed. Get one with ``load``.

    Attributes:
        skeleton: its joint tree. window_poses, window_seconds: the motion window. gaussians: N.
        nodes: at which the networks are evaluated. spacing, node_spacing: mean distances between Gaussians and between
            nodes, m. trained_light: [32, 64, 3] linear radiance.
        posed_outside: False for a graph that poses, which it does in the root's frame alone.
        metadata: all of the file's metadata. advice: how it may be played.
    """

    def __init__(self, networks: Networks) -> None:
        self._networks, metadata = networks, networks.metadata
        self.metadata, self.advice, self.trained_light = metadata, networks.advice, networks.trained_light
        tree = metadata.skeleton
        self.skeleton = Skeleton(tuple(tree.names), np.array(tree.parents), np.array(tree.rest_joints, np.float64))
        self.window_poses, self.window_seconds = metadata.window_poses, metadata.window_seconds
        self.gaussians, self.spacing = metadata.gaussians, metadata.spacing_m
        self.nodes = networks.nodes if networks.posed_outside else 0
        self._opacities, albedo, self._roughness = networks.materials
        self._albedo = np.minimum(albedo, np.float32(LARGEST_ALBEDO))
        self.posed_outside = networks.posed_outside
        self._rest = _rest_pose(networks) if networks.posed_outside else None
        self._levels = [self]  # of all levels, as is the next
        self._merging: list[MergedLevels] = []

    @classmethod
    def load(cls, path: str | Path, *, threads: int | None = None, ahead: Future[Networks] | None = None) -> Avatar:
        """Read an avatar. ``threads``: of onnxruntime; by default one per core.

        Args:
            ahead: its networks, where they are being loaded already, with threads of their own: see
                ``playback.start.load_ahead``.

        Raises:
            InputError: for anything that is not a complete avatar of a known schema.
        """
        networks = Networks.load(path, threads) if ahead is None else ahead.result()
        try:
            return cls(networks)
        except InputError as error:
            raise error.at(file=path) from error

    def level(self, number: int) -> Avatar | None:
        """At a level of detail: 0 is itself, others are for fewer and fewer pixels; None beyond the coarsest.

        The first have all Gaussians and a share of the nodes, where the file allows that, and leave out the body's far
        side; others have no more nodes. They are made on first use, each in a hundredth of a second.
        """
        if number < len(self._unmerged):
            return self._unmerged[number]
        if (detail := self.detail(number)) is None:
            return None
        surface = self._merged.surface(number - len(self._unmerged) + 1)
        level = shallow_copy(self._unmerged[-1], gaussians=detail.gaussians, spacing=detail.spacing)
        level._rest, level._opacities, level._albedo, level._roughness = surface
        return level

    def detail(self, number: int) -> Detail | None:
        """What ``level`` would have."""
        if number < len(self._unmerged):
            level = self._unmerged[number]
            return Detail(level.gaussians, level.spacing, level.node_spacing)
        if self._unmerged[0]._rest is None:
            return None
        if (fewer := self._merged.count(number - len(self._unmerged) + 1)) is None:
            return None
        finest = self._unmerged[-1]
        return Detail(fewer, finest.spacing * math.sqrt(finest.gaussians / fewer), finest.node_spacing)

    @property
    def _unmerged(self) -> list[Avatar]:
        """Levels with all Gaussians."""
        if len(self._levels) == 1 and self._networks.can_leave_out_nodes:
            self._levels += [self._culled(*each) for each in CULLED_LEVELS]
        return self._levels

    @property
    def _merged(self) -> MergedLevels:
        """Levels with fewer, from the last one with all on."""
        if not self._merging:
            finest = self._unmerged[-1]
            assert finest._rest is not None
            surface = Surface(finest._rest, finest._opacities, finest._albedo, finest._roughness)
            self._merging.append(MergedLevels(surface))
        return self._merging[0]

    def _culled(self, share: int, cull: float) -> Avatar:
        """On every ``share``-th node, without what is below n·v = ``cull``."""
        assert self._rest is not None
        kept = np.arange(0, self.nodes, share)
        advised = cull if self.advice.cull is None else max(cull, self.advice.cull)
        level = shallow_copy(self, nodes=len(kept), advice=msgspec.structs.replace(self.advice, cull=advised))
        level._networks, level._rest = self._networks.at_nodes(kept.tolist()), on_fewer_nodes(self._rest, kept)
        return level

    @property
    def node_spacing(self) -> float:
        return self.spacing * math.sqrt(self.gaussians / self.nodes) if self.nodes else math.inf

    def scale_albedo(self, gain: Sequence[float]) -> None:
        """Multiply the albedo by ``gain`` [3] of linear R, G and B; it stays below what conserves energy.

        Levels made before stay.
        """
        scaled = self._albedo * np.asarray(gain, np.float32)
        self._albedo = np.clip(scaled, 0, np.float32(LARGEST_ALBEDO))

    def pose(self, motion: Motion, time: float) -> Gaussians:
        """The avatar at ``time`` seconds of ``motion`` (mapped to its skeleton), in the world frame."""
        return self.posed(self.encode(motion, time).in_world())

    def encode(self, motion: Motion, time: float) -> Encoded:
        """The first half of ``pose``: the networks. Runs in onnxruntime, so it may overlap any kernel."""
        started = perf_counter()
        window, velocity, bones, root = moment(
            motion, time, self.skeleton, poses=self.window_poses, seconds=self.window_seconds
        )
        known = perf_counter()
        values = self._networks.at((window, velocity, bones))
        return Encoded(self, values, bones, root, {"motion": known - started, "encoders": perf_counter() - known})

    def posed(self, encoded: Encoded) -> Gaussians:
        """The second half of ``pose``, in the frame of ``encoded``."""
        values, bones = encoded.values, encoded.bones
        if self._rest is None:
            means, covariances, normals, visibility = values
        else:
            *logits, offsets, visibility = values
            posed = self._rest.pose(logits[0] if logits else None, offsets, visibility, bones)
            means, covariances, normals, visibility = posed
        return Gaussians(
            means,
            covariances,
            self._opacities,
            normals,
            self._albedo,
            self._roughness,
            visibility,
            np.ascontiguousarray(bones[0, :, :3], np.float32),
        )

    def joints(self, encoded: Encoded) -> NDArray[np.float64]:
        """Joint positions [J, 3] m in the frame of ``encoded``."""
        rest = self.skeleton.rest_joints
        return np.asarray(np.einsum("jab,jb->ja", encoded.bones[:, :, :3], rest) + encoded.bones[:, :, 3], np.float64)

    def unposed(self, encoded: Encoded) -> Unposed | None:
        """Inputs of posing on another device; None where the graph poses."""
        if self._rest is None:
            return None
        *logits, offsets, visibility = encoded.values
        return Unposed(
            self._rest,
            logits[0] if logits else None,
            offsets,
            visibility,
            encoded.bones,
            self._opacities,
            self._albedo,
            self._roughness,
        )

    def run(self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike], outputs: Sequence[str]) -> list[NDArray[np.float32]]:
        """Named outputs of the graph: ``avatar.networks.Networks.run``."""
        return self._networks.run(inputs, outputs)


def _rest_pose(networks: Networks) -> RestPose:
    neighbours, weights, log_template, *rest, limits = networks.rest
    nodes = networks.nodes
    inside = neighbours.size and neighbours.min() >= 0 and neighbours.max() < nodes
    if neighbours.shape != weights.shape or not inside:
        expected = f"{list(weights.shape)} of {nodes} nodes, from 0"
        raise InputError(REST_OUTPUTS[0], expected=expected, got=_range(neighbours))
    max_offset, floor, fallback = limits.tolist()
    points, factors, normals, limbs = rest
    return RestPose(
        neighbours.astype(np.int32), weights, log_template, points, factors, normals, limbs, max_offset, floor, fallback
    )


def _range(values: NDArray[Any]) -> str:
    return f"{list(values.shape)} from {values.min()} to {values.max()}" if values.size else "none"
