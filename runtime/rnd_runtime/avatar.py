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
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .files import existing_file
from .gaussians import Gaussians
from .motion import Motion
from .skeleton import Skeleton, bone_transforms
from .window import motion_window

SCHEMA = "rnd-avatar/1"
METADATA_KEY = "rnd_avatar"
PROBE_SHAPE = (32, 64, 3)
POSED_OUTPUTS = ("means", "covariances", "normals", "visibility")
CONSTANT_OUTPUTS = ("opacities", "albedo", "roughness")


class SkeletonMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joint names, parents (−1 for the root, which comes first) and rest positions [J, 3] in metres."""

    names: list[str]
    parents: list[int]
    rest_joints: list[tuple[float, float, float]]


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


class Avatar:
    """An avatar read from ``avatar.onnx``, ready to be posed. Get one with :meth:`load`.

    Attributes:
        skeleton: its joint tree. window_poses, window_seconds: the motion window. gaussians: N.
        spacing: mean distance between Gaussians, m. trained_light: [32, 64, 3] linear radiance.
        metadata: everything the file says of itself.
    """

    def __init__(
        self, session: ort.InferenceSession, metadata: AvatarMetadata, trained_light: NDArray[np.float32]
    ) -> None:
        self._session = session
        self.metadata = metadata
        self.trained_light = trained_light
        tree = metadata.skeleton
        self.skeleton = Skeleton(
            tuple(tree.names), np.array(tree.parents), np.array(tree.rest_joints, np.float64)
        )
        self.window_poses, self.window_seconds = metadata.window_poses, metadata.window_seconds
        self.gaussians, self.spacing = metadata.gaussians, metadata.spacing_m
        rest = bone_transforms(self.skeleton, np.tile(np.eye(3), (len(tree.names), 1, 1)), np.zeros(3))
        window = np.tile(_IDENTITY_6D, (self.window_poses, len(tree.names) - 1, 1))
        still = (window, np.zeros((len(tree.names) - 1, 3)), rest)
        self._opacities, self._albedo, self._roughness = self.run(still, CONSTANT_OUTPUTS)

    @classmethod
    def load(cls, path: str | Path, *, threads: int | None = None) -> Avatar:
        """Read an avatar. ``threads``: of onnxruntime; by default one per core.

        Raises :class:`InputError` for anything that is not a whole avatar of the schema we know.
        """
        path = existing_file(path, what="avatar")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # its complaints about broken files go into our one line instead
        try:
            session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise InputError("not a readable ONNX model", got=_first_line(error), file=path) from error
        metadata = _read_metadata(session, path)
        _check_shapes(session, metadata, path)
        try:
            return cls(session, metadata, _decode_light(metadata, path))
        except InputError as error:
            raise InputError(str(error), file=path) from error

    def pose(self, motion: Motion, time: float) -> Gaussians:
        """The avatar at ``time`` seconds of ``motion`` (mapped to its skeleton), in the world frame."""
        window, velocity = motion_window(motion, time, poses=self.window_poses, seconds=self.window_seconds)
        now = motion.at(np.array([time]))
        bones = bone_transforms(self.skeleton, now.rotations[0], now.translations[0])
        means, covariances, normals, visibility = self.run((window, velocity, bones), POSED_OUTPUTS)
        return Gaussians(
            means, covariances, self._opacities, normals, self._albedo, self._roughness, visibility,
            np.ascontiguousarray(bones[0, :, :3], np.float32),
        )  # fmt: skip

    def run(
        self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike], outputs: Sequence[str]
    ) -> list[NDArray[np.float32]]:
        """Named outputs of the graph for (pose_window, joint_velocity, bone_transforms)."""
        values = {
            name: np.ascontiguousarray(value, np.float32)
            for name, value in zip(("pose_window", "joint_velocity", "bone_transforms"), inputs)
        }
        results: list[NDArray[np.float32]] = self._session.run(list(outputs), values)
        return results


_IDENTITY_6D = np.array([1, 0, 0, 0, 1, 0], np.float32)


def _read_metadata(session: ort.InferenceSession, path: Path) -> AvatarMetadata:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise InputError("not an RnD avatar", expected=f"metadata {METADATA_KEY!r}", got="none", file=path)
    try:
        schema = msgspec.json.decode(text.encode(), type=_SchemaOnly).schema
        if schema != SCHEMA:
            raise InputError("schema", expected=SCHEMA, got=schema, file=path, hint="made by another version")
        metadata = msgspec.json.decode(text.encode(), type=AvatarMetadata)
    except msgspec.DecodeError as error:
        raise InputError("metadata", got=_first_line(error), file=path) from error
    tree = metadata.skeleton
    if not len(tree.names) == len(tree.parents) == len(tree.rest_joints) >= 2:
        raise InputError("skeleton", expected="as many names, parents and rest joints", file=path)
    return metadata


class _SchemaOnly(msgspec.Struct):
    schema: str


def _check_shapes(session: ort.InferenceSession, metadata: AvatarMetadata, path: Path) -> None:
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
    for what, expected, found in (
        ("inputs", inputs, session.get_inputs()),
        ("outputs", outputs, session.get_outputs()),
    ):
        got = {value.name: value.shape for value in found if value.type == "tensor(float)"}
        if got != expected:
            raise InputError(f"graph {what}", expected=expected, got=got, file=path)


def _decode_light(metadata: AvatarMetadata, path: Path) -> NDArray[np.float32]:
    try:
        values = np.frombuffer(base64.b64decode(metadata.trained_light, validate=True), "<f4")
        return values.reshape(PROBE_SHAPE)
    except (binascii.Error, ValueError) as error:
        raise InputError(
            "trained_light", expected=f"float32 of shape {PROBE_SHAPE}", got=error, file=path
        ) from error


def encode_light(radiance: NDArray[np.float32]) -> str:
    """A probe [32, 64, 3] as the metadata stores it."""
    assert radiance.shape == PROBE_SHAPE
    return base64.b64encode(np.ascontiguousarray(radiance, "<f4").tobytes()).decode()


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:300] if str(error).strip() else type(error).__name__
