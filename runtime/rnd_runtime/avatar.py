"""An ``avatar.onnx`` at work: its networks in onnxruntime, the rest of its posing in our kernel."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike, NDArray

from .avatar_file import (
    CONSTANT_OUTPUTS,
    NODE_LOGITS,
    NODE_OUTPUTS,
    POSED_OUTPUTS,
    REST_OUTPUTS,
    AvatarMetadata,
    check_shapes,
    decode_light,
    first_line,
    read_advice,
    read_metadata,
)
from .brdf import LARGEST_ALBEDO
from .errors import InputError
from .files import existing_file
from .forearm import skinning_bones
from .gaussians import Gaussians
from .motion import Motion
from .onnx_parts import OnnxFile
from .posing import RestPose, Unposed
from .skeleton import Skeleton, taken_along
from .window import described, recent_poses


class Encoded(NamedTuple):
    """What the networks say of one pose, for :meth:`Avatar.posed`.

    It is posed in the root's frame, which leaves the root's own turn and path to camera and light: float32 then has to
    resolve a body and not its place in the world, and where all three turn together the picture stays.
    """

    values: list[
        NDArray[np.float32]
    ]  # node outputs: logits, unless skinning is static, offsets and visibility
    bones: NDArray[np.float32]  # [J, 3, 4] m, rest pose → this frame
    root: NDArray[np.float64]  # [4, 4] m, this frame → world
    seconds: dict[str, float]  # that "motion" and "encoders" took

    def in_world(self) -> Encoded:
        """The same, to be posed in the world."""
        return self._replace(bones=taken_along(self.bones, self.root), root=np.eye(4))


class Avatar:
    """An avatar read from ``avatar.onnx``, ready to be posed. Get one with :meth:`load`.

    Attributes:
        skeleton: its joint tree. window_poses, window_seconds: the motion window. gaussians: N.
        spacing: mean distance between Gaussians, m. trained_light: [32, 64, 3] linear radiance.
        metadata: everything the file says of itself. advice: how it may be played.
    """

    def __init__(
        self,
        file: OnnxFile,
        metadata: AvatarMetadata,
        trained_light: NDArray[np.float32],
        threads: int | None = None,
        path: Path | None = None,
    ) -> None:
        self._file, self._threads, self._path = file, threads or os.cpu_count() or 1, path
        self._sessions: dict[tuple[str, ...], ort.InferenceSession] = {}
        self.metadata, self.advice = metadata, read_advice(file)
        self.trained_light = trained_light
        tree = metadata.skeleton
        self.skeleton = Skeleton(
            tuple(tree.names), np.array(tree.parents), np.array(tree.rest_joints, np.float64)
        )
        self.window_poses, self.window_seconds = metadata.window_poses, metadata.window_seconds
        self.gaussians, self.spacing = metadata.gaussians, metadata.spacing_m
        posed_here = not {*NODE_OUTPUTS, *REST_OUTPUTS} - file.outputs.keys()
        self._aside = ThreadPoolExecutor(1, "networks")
        self._networks = self._parts() if posed_here else (POSED_OUTPUTS,)
        sessions = self._aside.submit(lambda: [self._session(part) for part in self._networks])
        self._opacities, albedo, self._roughness = self._constants(CONSTANT_OUTPUTS)
        self._albedo = np.minimum(albedo, np.float32(LARGEST_ALBEDO))
        self._rest = self._rest_pose() if posed_here else None
        sessions.result()

    @classmethod
    def load(cls, path: str | Path, *, threads: int | None = None) -> Avatar:
        """Read an avatar. ``threads``: of onnxruntime; by default one per core.

        Raises :class:`InputError` for anything that is not a whole avatar of the schema we know.
        """
        path = existing_file(path, what="avatar")
        try:
            file = OnnxFile(path.read_bytes())
            metadata = read_metadata(file)
            check_shapes(file, metadata)
            return cls(file, metadata, decode_light(metadata), threads, path)
        except InputError as error:
            raise error.at(file=path) from error

    def pose(self, motion: Motion, time: float) -> Gaussians:
        """The avatar at ``time`` seconds of ``motion`` (mapped to its skeleton), in the world frame."""
        return self.posed(self.encode(motion, time).in_world())

    def encode(self, motion: Motion, time: float) -> Encoded:
        """The first half of :meth:`pose`: what the networks say. Runs in onnxruntime, so it may overlap any kernel."""
        started = perf_counter()
        poses, seconds = self.window_poses, self.window_seconds
        recent = recent_poses(motion, time, poses=poses, seconds=seconds)
        window, velocity = described(recent, poses=poses, seconds=seconds)
        bones, root = self._bones(recent.rotations[-1], recent.translations[-1])
        known = perf_counter()
        inputs = (window, velocity, bones)
        own, *others = self._networks
        aside = [self._aside.submit(self.run, inputs, part) for part in others]
        values = self.run(inputs, own) + [value for part in aside for value in part.result()]
        return Encoded(values, bones, root, {"motion": known - started, "encoders": perf_counter() - known})

    def posed(self, encoded: Encoded) -> Gaussians:
        """The second half of :meth:`pose`, in the frame of ``encoded``."""
        values, bones = encoded.values, encoded.bones
        if self._rest is None:
            means, covariances, normals, visibility = values
        else:
            *logits, offsets, harmonics = values
            posed = self._rest.pose(logits[0] if logits else None, offsets, harmonics, bones)
            means, covariances, normals, visibility = posed
        return Gaussians(
            means, covariances, self._opacities, normals, self._albedo, self._roughness, visibility,
            np.ascontiguousarray(bones[0, :, :3], np.float32),
        )  # fmt: skip

    def unposed(self, encoded: Encoded) -> Unposed | None:
        """What :meth:`posed` is made of, for those who pose elsewhere; None where the graph has posed already."""
        if self._rest is None:
            return None
        *logits, offsets, visibility = encoded.values
        return Unposed(
            self._rest, logits[0] if logits else None, offsets, visibility, encoded.bones,
            self._opacities, self._albedo, self._roughness,
        )  # fmt: skip

    def run(
        self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike], outputs: Sequence[str]
    ) -> list[NDArray[np.float32]]:
        """Named outputs of the graph for (pose_window, joint_velocity, bone_transforms); nothing else is computed.

        Raises :class:`InputError` where the file's graph cannot be evaluated: its indices are looked at only then.
        """
        session = self._session(tuple(outputs))
        given = dict(zip(("pose_window", "joint_velocity", "bone_transforms"), inputs))
        values = {
            wanted.name: np.ascontiguousarray(given[wanted.name], np.float32)
            for wanted in session.get_inputs()
        }
        try:
            return self._evaluated(session, outputs, values)
        except InputError as error:
            raise error.at(file=self._path) from error

    def _evaluated(
        self, session: ort.InferenceSession, outputs: Sequence[str], values: dict[str, NDArray[np.float32]]
    ) -> list[NDArray[np.float32]]:
        try:
            results: list[NDArray[np.float32]] = session.run(list(outputs), values)
        except Exception as error:
            raise InputError("graph cannot be evaluated", got=first_line(error)) from error
        self._check_promised(outputs, results)
        return results

    def _check_promised(self, outputs: Sequence[str], values: Sequence[NDArray[Any]]) -> None:
        """The kernels that go over ``values`` check no bounds."""
        for name, value in zip(outputs, values):
            promised = self._file.outputs[name]
            if promised and list(value.shape) != promised:  # integers' shapes are not read
                raise InputError(name, expected=f"shape {promised}", got=list(value.shape))

    def _bones(
        self, rotations: NDArray[np.float64], translation: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """``bones`` and ``root`` of :class:`Encoded` for one pose [J, 3, 3] and its translation [3] m."""
        root, place = np.eye(4), self.skeleton.rest_joints[0]
        root[:3, :3] = rotations[0]
        root[:3, 3] = place + translation - rotations[0] @ place
        local = np.concatenate([np.eye(3)[None], rotations[1:]])
        return skinning_bones(self.skeleton, local, np.zeros(3)), root

    def _rest_pose(self) -> RestPose:
        neighbours, weights, log_template, *rest, limits = self._constants(REST_OUTPUTS)
        nodes = self._file.outputs[NODE_OUTPUTS[0]][0]
        inside = neighbours.size and neighbours.min() >= 0 and neighbours.max() < nodes
        if neighbours.shape != weights.shape or not inside:
            expected = f"{list(weights.shape)} of {nodes} nodes, from 0"
            raise InputError(REST_OUTPUTS[0], expected=expected, got=_range(neighbours))
        max_offset, floor, fallback = limits.tolist()
        points, factors, normals, limbs = rest
        return RestPose(
            neighbours.astype(np.int32), weights, log_template, points, factors, normals, limbs,
            max_offset, floor, fallback,
        )  # fmt: skip

    def _constants(self, outputs: Sequence[str]) -> list[NDArray[np.float32]]:
        session = _session(self._file.cut(outputs), 1)
        if session.get_inputs():
            names = ", ".join(outputs)
            raise InputError("graph outputs", expected=f"{names}: constants", got="some that need a pose")
        return self._evaluated(session, outputs, {})

    def _session(self, outputs: tuple[str, ...]) -> ort.InferenceSession:
        """A session that computes ``outputs`` and no more; kept."""
        if outputs not in self._sessions:
            at_once = len(self._networks) if outputs in self._networks else 1
            threads = -(-self._threads // at_once)
            self._sessions[outputs] = _session(self._file.cut(outputs), threads)
        return self._sessions[outputs]

    def _parts(self) -> tuple[tuple[str, ...], ...]:
        """What of the networks is evaluated at once: that of skinning takes as long as the two others. On a core each,
        none of their hundred operations has to wait for a second thread."""
        skinning = (NODE_LOGITS,) if NODE_LOGITS in self._file.outputs else ()
        if skinning and self._threads > 1:
            return skinning, NODE_OUTPUTS
        return ((*skinning, *NODE_OUTPUTS),)


def _session(model: bytes, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Threads that spin on take the cores from the kernels that follow, and from everyone on a busy machine: at load 13
    # a run of 30 000 Gaussians' networks takes 28 ms without and 157 ms with it (medians). As long as an operation's
    # gap they may: 3.2 ms instead of 3.8 on an idle machine, 5.3 instead of 4.1 beside two busy processes.
    options.add_session_config_entry("session.intra_op.spin_duration_us", "50")
    options.log_severity_level = 4  # its complaints about broken files go into our one line instead
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError("not a readable ONNX model", got=first_line(error)) from error


def _range(values: NDArray[Any]) -> str:
    return f"{list(values.shape)} from {values.min()} to {values.max()}" if values.size else "none"
