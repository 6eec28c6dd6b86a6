"""The contract of avatar.onnx, its metadata, and whether a file keeps it.

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
``core.gaussians.Gaussians`` for units and frames. Metadata is JSON under ``rnd_avatar`` in the
model's ``metadata_props``: ``AvatarMetadata``. What a player may do to be faster, JSON under ``rnd_player``, is
advice: ``PlayerAdvice``.

That is the complete avatar for any ONNX runtime. For our faster posing kernel a file also names the values between its
networks and the Gaussians: ``node_offsets`` [M, 6], ``node_visibility`` [M, S] and, where skinning
is dynamic, ``node_logits`` [M, J], and the constants ``neighbours`` [N, K] (int32), ``neighbour_weights`` [N, K],
``log_template`` [N, J], ``rest_points`` [N, 3], ``rest_factors`` [N, 9], ``rest_normals`` [N, 3], ``rest_limbs`` [N, 7]
and ``posing_limits`` [3]; see ``posing.rest.RestPose``. Without these the graph does all of the posing.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError, first_line

from .onnx_parts import OnnxFile

T = TypeVar("T")

SCHEMA = "rnd-avatar/1"
METADATA_KEY = "rnd_avatar"
ADVICE_KEY = "rnd_player"
PROBE_SHAPE = (32, 64, 3)
EncoderKind = Literal["full", "coarse", "static"]
Precision = Literal["f32", "f16", "int8"]
POSED_OUTPUTS = ("means", "covariances", "normals", "visibility")
CONSTANT_OUTPUTS = ("opacities", "albedo", "roughness")
NODE_OUTPUTS = ("node_offsets", "node_visibility")
NODE_LOGITS = "node_logits"
REST_OUTPUTS = (
    "neighbours",
    "neighbour_weights",
    "log_template",
    "rest_points",
    "rest_factors",
    "rest_normals",
    "rest_limbs",
    "posing_limits",
)

_SIZES: dict[int | str, range] = {"M": range(1, 2**31), "K": range(1, 2**31), "1 to 16": range(1, 17)}
"""bounds of sizes that no other one determines"""


_Count = Annotated[int, msgspec.Meta(ge=1)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]


class SkeletonMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joint names, parents (−1 for the root, which comes first) and rest positions [J, 3] in metres."""

    names: list[str]
    parents: list[int]
    rest_joints: list[tuple[float, float, float]]


class VariantMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file leaves out for speed or size. The defaults are the complete avatar.

    ``encoder``: networks at every node, at fewer (``coarse``), or the template's skinning (``static``).
    ``precision``: how constants are stored. ``nodes``: M, the most at which networks are evaluated, 0 if unknown.
    ``dynamic_nodes``: of the skinning network. ``visibility_degree``: of the SH coefficients stored.
    """

    encoder: EncoderKind = "full"
    precision: Precision = "f32"
    nodes: int = 0
    dynamic_nodes: int = 0
    visibility_degree: int = 3


class AvatarMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The metadata of an avatar.onnx. Unknown fields and schemas are refused.

    ``trained_light``: base64 of the little-endian float32 probe [32, 64, 3] it was trained under.
    """

    schema: str
    gaussians: _Count
    spacing_m: _Positive
    window_poses: _Count
    window_seconds: _Positive
    skeleton: SkeletonMetadata
    trained_light: str
    body_license: str
    checkpoint_sha256: str
    conventions: str
    generator: str
    variant: VariantMetadata = VariantMetadata()


class PlayerAdvice(msgspec.Struct, frozen=True):
    """How the exporter found that the avatar may be played. A reader may leave any of it alone, fields it does not know
    among them.

    ``cull``: n·v below which a Gaussian is not missed, see ``raster.in_view.in_view``; None where none may be
    left out.
    """

    cull: Annotated[float, msgspec.Meta(ge=-1, le=1)] | None = None


def read_advice(file: OnnxFile) -> PlayerAdvice:
    """The advice of ``file``; empty if it has none."""
    try:
        return msgspec.json.decode(file.metadata.get(ADVICE_KEY, "{}").encode(), type=PlayerAdvice)
    except msgspec.DecodeError as error:
        raise InputError(f"metadata {ADVICE_KEY!r}", got=first_line(error)) from error


def read_metadata(file: OnnxFile) -> AvatarMetadata:
    text = file.metadata.get(METADATA_KEY)
    if text is None:
        raise InputError("not an RnD avatar", expected=f"metadata {METADATA_KEY!r}", got="none")
    try:
        schema = msgspec.json.decode(text.encode(), type=_SchemaOnly).schema
        if schema != SCHEMA:
            raise InputError("schema", expected=SCHEMA, got=schema, hint="made by another version")
        metadata = msgspec.json.decode(text.encode(), type=AvatarMetadata)
    except msgspec.DecodeError as error:
        raise InputError("metadata", got=first_line(error)) from error
    tree = metadata.skeleton
    if not len(tree.names) == len(tree.parents) == len(tree.rest_joints) >= 2:
        raise InputError("skeleton", expected="as many names, parents and rest joints")
    return metadata


def metadata_of(avatar_file: Path) -> AvatarMetadata:
    """The metadata of ``avatar_file``. Raises ``InputError`` naming the file."""
    return _read(avatar_file, read_metadata)


def advice_of(avatar_file: Path) -> PlayerAdvice:
    """The advice of ``avatar_file``. Raises ``InputError`` naming the file."""
    return _read(avatar_file, read_advice)


def _read(avatar_file: Path, what: Callable[[OnnxFile], T]) -> T:
    try:
        return what(OnnxFile(avatar_file.read_bytes()))
    except InputError as error:
        raise error.at(file=avatar_file) from error


class _SchemaOnly(msgspec.Struct):
    schema: str


def check_shapes(file: OnnxFile, metadata: AvatarMetadata) -> None:
    """The graph's inputs and outputs must be what the metadata promises."""
    n, d, joints = metadata.gaussians, metadata.window_poses, len(metadata.skeleton.names)
    inputs = {"pose_window": [d, joints - 1, 6], "joint_velocity": [joints - 1, 3], "bone_transforms": [joints, 3, 4]}
    outputs = {
        "means": [n, 3],
        "covariances": [n, 6],
        "normals": [n, 3],
        "visibility": [n, 16],
        "skinning_weights": [n, joints],
        "opacities": [n],
        "albedo": [n, 3],
        "roughness": [n],
    }
    if file.inputs != inputs:
        raise InputError("graph inputs", expected=inputs, got=file.inputs)
    got = {name: shape for name, shape in file.outputs.items() if name in outputs}
    if got != outputs:
        raise InputError("graph outputs", expected=outputs, got=got)
    if {*NODE_OUTPUTS, *REST_OUTPUTS} <= file.outputs.keys():
        _check_posing_shapes(file.outputs, n, joints)


def _check_posing_shapes(outputs: Mapping[str, list[int]], n: int, joints: int) -> None:
    """Check the outputs that the compiled kernel poses from: M nodes of ≤ 16 SH coefficients, N Gaussians."""
    nodes = next(iter(outputs["node_offsets"]), 0)
    wanted: dict[str, list[int | str]] = {
        "node_offsets": ["M", 6],
        "node_visibility": [nodes, "1 to 16"],
        NODE_LOGITS: [nodes, joints],
        "neighbour_weights": [n, "K"],
        "log_template": [n, joints],
        "rest_points": [n, 3],
        "rest_factors": [n, 9],
        "rest_normals": [n, 3],
        "rest_limbs": [n, 7],
        "posing_limits": [3],
    }
    for name, sizes in wanted.items():
        if (shape := outputs.get(name)) is None:  # node_logits, where skinning is the template's
            continue
        fits = (size in _SIZES.get(want, (want,)) for size, want in zip(shape, sizes))
        if len(shape) != len(sizes) or not all(fits):
            raise InputError(name, expected=f"[{', '.join(map(str, sizes))}]", got=shape)


def decode_light(metadata: AvatarMetadata) -> NDArray[np.float32]:
    try:
        values = np.frombuffer(base64.b64decode(metadata.trained_light, validate=True), "<f4")
        light = values.reshape(PROBE_SHAPE)
    except (binascii.Error, ValueError) as error:
        raise InputError("trained_light", expected=f"float32 of shape {PROBE_SHAPE}", got=error) from error
    if not (np.isfinite(light) & (light >= 0)).all():
        raise InputError("trained_light", expected="finite radiance, not negative")
    return light


def encode_light(radiance: NDArray[np.float32]) -> str:
    """A probe [32, 64, 3] as the metadata stores it."""
    assert radiance.shape == PROBE_SHAPE
    return base64.b64encode(np.ascontiguousarray(radiance, "<f4").tobytes()).decode()
