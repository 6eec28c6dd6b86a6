"""avatar.onnx: its contract, its metadata, and running it.

One self-contained ONNX file (opset 18, standard operators, static shapes). For d window poses, J joints,
N Gaussians:

======================  ============  ==============================================================
input                   shape         meaning
======================  ============  ==============================================================
``pose_window``         [d, J−1, 6]   6D rotations of the joints but the root, oldest pose first
``joint_velocity``      [J−1, 3]      rad/s, log(R_{t−δ}ᵀ R_t)/δ
``bone_transforms``     [J, 3, 4]     rest pose → posed world, metres
======================  ============  ==============================================================

Outputs are ``means`` [N, 3], ``covariances`` [N, 6], ``normals`` [N, 3], ``visibility`` [N, 16] and
``skinning_weights`` [N, J], and the constants ``opacities`` [N], ``albedo`` [N, 3] and ``roughness`` [N]; see
:class:`rnd_runtime.gaussians.Gaussians` for units and frames. Metadata is JSON under ``rnd_avatar`` in the
model's ``metadata_props``: :class:`AvatarMetadata`.

That is the whole avatar for any ONNX runtime. For ours, which poses faster than a graph does, a file also names what
stands between its networks and the Gaussians: ``node_offsets`` [M, 6], ``node_visibility`` [M, S] and, where skinning
is dynamic, ``node_logits`` [M, J], and the constants ``neighbours`` [N, K] (int32), ``neighbour_weights`` [N, K],
``log_template`` [N, J], ``rest_points`` [N, 3], ``rest_factors`` [N, 9], ``rest_normals`` [N, 3], ``rest_limbs`` [N, 7]
and ``posing_limits`` [3]; see :class:`rnd_runtime.posing.RestPose`. Without these the graph does all of the posing.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike, NDArray

from .brdf import LARGEST_ALBEDO
from .errors import InputError
from .files import existing_file
from .gaussians import Gaussians
from .motion import Motion
from .onnx_parts import OnnxFile
from .posing import RestPose, Unposed
from .skeleton import Skeleton, bone_transforms, taken_along
from .window import described, recent_poses

SCHEMA = "rnd-avatar/1"
METADATA_KEY = "rnd_avatar"
PROBE_SHAPE = (32, 64, 3)
EncoderKind = Literal["full", "coarse", "static"]
Precision = Literal["f32", "f16", "int8"]
POSED_OUTPUTS = ("means", "covariances", "normals", "visibility")
CONSTANT_OUTPUTS = ("opacities", "albedo", "roughness")
NODE_OUTPUTS = ("node_offsets", "node_visibility")
NODE_LOGITS = "node_logits"
REST_OUTPUTS = (
    "neighbours", "neighbour_weights", "log_template", "rest_points", "rest_factors", "rest_normals", "rest_limbs",
    "posing_limits",
)  # fmt: skip


class SkeletonMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joint names, parents (−1 for the root, which comes first) and rest positions [J, 3] in metres."""

    names: list[str]
    parents: list[int]
    rest_joints: list[tuple[float, float, float]]


class VariantMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file has left out for speed or size. The defaults are the whole avatar.

    ``encoder``: networks at every node, at fewer (``coarse``), or the template's skinning (``static``).
    ``precision``: how constants are stored. ``nodes``: where networks are evaluated, 0 when not stated.
    ``dynamic_nodes``: those of them with dynamic skinning. ``visibility_degree``: of the harmonics that are kept.
    """

    encoder: EncoderKind = "full"
    precision: Precision = "f32"
    nodes: int = 0
    dynamic_nodes: int = 0
    visibility_degree: int = 3


class AvatarMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What an avatar.onnx says of itself. Unknown fields and schemas are refused.

    ``trained_light``: base64 of the little-endian float32 probe [32, 64, 3] it was trained under.
    """

    schema: str
    gaussians: int
    spacing_m: float
    window_poses: int
    window_seconds: float
    skeleton: SkeletonMetadata
    trained_light: str
    body_license: str
    checkpoint_sha256: str
    conventions: str
    generator: str
    variant: VariantMetadata = VariantMetadata()


class Encoded(NamedTuple):
    """What the networks say of one pose, for :meth:`Avatar.posed`.

    It is posed in the root's frame, which leaves the root's own turn and path to camera and light: float32 then has to
    resolve a body and not its place in the world, and where all three turn together the picture stays.
    """

    values: list[NDArray[np.float32]]
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
        metadata: everything the file says of itself.
    """

    def __init__(
        self,
        file: OnnxFile,
        metadata: AvatarMetadata,
        trained_light: NDArray[np.float32],
        threads: int | None = None,
    ) -> None:
        self._file, self._threads = file, threads
        self._sessions: dict[tuple[str, ...], ort.InferenceSession] = {}
        self.metadata = metadata
        self.trained_light = trained_light
        tree = metadata.skeleton
        self.skeleton = Skeleton(
            tuple(tree.names), np.array(tree.parents), np.array(tree.rest_joints, np.float64)
        )
        self.window_poses, self.window_seconds = metadata.window_poses, metadata.window_seconds
        self.gaussians, self.spacing = metadata.gaussians, metadata.spacing_m
        self._rest: RestPose | None = None
        self._opacities, albedo, self._roughness = self._constants(CONSTANT_OUTPUTS)
        self._albedo = np.minimum(albedo, np.float32(LARGEST_ALBEDO))
        if not {*NODE_OUTPUTS, *REST_OUTPUTS} - file.outputs.keys():
            self._rest = self._rest_pose()
            self._node_outputs = (*NODE_OUTPUTS, *({NODE_LOGITS} & file.outputs.keys()))
            self._session(self._node_outputs)  # now, and not in the first frame
        else:
            self._session(POSED_OUTPUTS)

    @classmethod
    def load(cls, path: str | Path, *, threads: int | None = None) -> Avatar:
        """Read an avatar. ``threads``: of onnxruntime; by default one per core.

        Raises :class:`InputError` for anything that is not a whole avatar of the schema we know.
        """
        path = existing_file(path, what="avatar")
        try:
            file = OnnxFile(path.read_bytes())
            metadata = _read_metadata(file)
            _check_shapes(file, metadata)
            return cls(file, metadata, _decode_light(metadata), threads)
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
        outputs = POSED_OUTPUTS if self._rest is None else self._node_outputs
        values = self.run((window, velocity, bones), outputs)
        return Encoded(values, bones, root, {"motion": known - started, "encoders": perf_counter() - known})

    def posed(self, encoded: Encoded) -> Gaussians:
        """The second half of :meth:`pose`, in the frame of ``encoded``."""
        values, bones = encoded.values, encoded.bones
        if self._rest is None:
            means, covariances, normals, visibility = values
        else:
            offsets, harmonics, *logits = values
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
        offsets, visibility, *logits = encoded.values
        return Unposed(
            self._rest, logits[0] if logits else None, offsets, visibility, encoded.bones,
            self._opacities, self._albedo, self._roughness,
        )  # fmt: skip

    def run(
        self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike], outputs: Sequence[str]
    ) -> list[NDArray[np.float32]]:
        """Named outputs of the graph for (pose_window, joint_velocity, bone_transforms); nothing else is computed."""
        session = self._session(tuple(outputs))
        values = dict(zip(("pose_window", "joint_velocity", "bone_transforms"), inputs))
        values = {
            wanted.name: np.ascontiguousarray(values[wanted.name], np.float32)
            for wanted in session.get_inputs()
        }
        results: list[NDArray[np.float32]] = session.run(list(outputs), values)
        return results

    def _bones(
        self, rotations: NDArray[np.float64], translation: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """``bones`` and ``root`` of :class:`Encoded` for one pose [J, 3, 3] and its translation [3] m."""
        root, place = np.eye(4), self.skeleton.rest_joints[0]
        root[:3, :3] = rotations[0]
        root[:3, 3] = place + translation - rotations[0] @ place
        local = np.concatenate([np.eye(3)[None], rotations[1:]])
        return bone_transforms(self.skeleton, local, np.zeros(3)), root

    def _rest_pose(self) -> RestPose:
        neighbours, weights, log_template, *rest, limits = self._constants(REST_OUTPUTS)
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
        results: list[NDArray[np.float32]] = session.run(list(outputs), {})
        return results

    def _session(self, outputs: tuple[str, ...]) -> ort.InferenceSession:
        """A session that computes ``outputs`` and no more; kept."""
        if outputs not in self._sessions:
            self._sessions[outputs] = _session(self._file.cut(outputs), self._threads or 0)
        return self._sessions[outputs]


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
        raise InputError("not a readable ONNX model", got=_first_line(error)) from error


def _read_metadata(file: OnnxFile) -> AvatarMetadata:
    text = file.metadata.get(METADATA_KEY)
    if text is None:
        raise InputError("not an RnD avatar", expected=f"metadata {METADATA_KEY!r}", got="none")
    try:
        schema = msgspec.json.decode(text.encode(), type=_SchemaOnly).schema
        if schema != SCHEMA:
            raise InputError("schema", expected=SCHEMA, got=schema, hint="made by another version")
        metadata = msgspec.json.decode(text.encode(), type=AvatarMetadata)
    except msgspec.DecodeError as error:
        raise InputError("metadata", got=_first_line(error)) from error
    tree = metadata.skeleton
    if not len(tree.names) == len(tree.parents) == len(tree.rest_joints) >= 2:
        raise InputError("skeleton", expected="as many names, parents and rest joints")
    return metadata


class _SchemaOnly(msgspec.Struct):
    schema: str


def _check_shapes(file: OnnxFile, metadata: AvatarMetadata) -> None:
    """The graph's inputs and outputs must be what the metadata promises."""
    n, d, joints = metadata.gaussians, metadata.window_poses, len(metadata.skeleton.names)
    inputs = {
        "pose_window": [d, joints - 1, 6],
        "joint_velocity": [joints - 1, 3],
        "bone_transforms": [joints, 3, 4],
    }
    outputs = {
        "means": [n, 3], "covariances": [n, 6], "normals": [n, 3], "visibility": [n, 16],
        "skinning_weights": [n, joints], "opacities": [n], "albedo": [n, 3], "roughness": [n],
    }  # fmt: skip
    if file.inputs != inputs:
        raise InputError("graph inputs", expected=inputs, got=file.inputs)
    got = {name: shape for name, shape in file.outputs.items() if name in outputs}
    if got != outputs:
        raise InputError("graph outputs", expected=outputs, got=got)


def _decode_light(metadata: AvatarMetadata) -> NDArray[np.float32]:
    try:
        values = np.frombuffer(base64.b64decode(metadata.trained_light, validate=True), "<f4")
        return values.reshape(PROBE_SHAPE)
    except (binascii.Error, ValueError) as error:
        raise InputError("trained_light", expected=f"float32 of shape {PROBE_SHAPE}", got=error) from error


def encode_light(radiance: NDArray[np.float32]) -> str:
    """A probe [32, 64, 3] as the metadata stores it."""
    assert radiance.shape == PROBE_SHAPE
    return base64.b64encode(np.ascontiguousarray(radiance, "<f4").tobytes()).decode()


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:300] if str(error).strip() else type(error).__name__
