"""The avatar's graph: the same mathematics as :mod:`rnd_trainer.model`, with everything static baked in.

The cross-attentions are written as two matrix products over all heads at once: the keys of the J−1 joints
stand block-diagonal [width, heads·(J−1)], and values, output projection and the layer behind them are one
matrix [heads·(J−1), width] that is made anew for each pose at next to no cost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import onnx

from rnd_trainer.config import ModelConfig
from rnd_trainer.encoders import VELOCITY_SCALE
from rnd_trainer.skinning import NORMAL_FALLBACK, THICKNESS_FLOOR

from .bake import BakedAttention, BakedAvatar, BakedMlp
from .graph_builder import GraphBuilder

PRODUCER = "rnd-avatar"
LAYER_NORM_EPSILON = 1e-5
NORMALIZE_FLOOR = 1e-9


def build_model(baked: BakedAvatar, config: ModelConfig, metadata: dict[str, str]) -> onnx.ModelProto:
    """The avatar as an ONNX model; see :mod:`rnd_runtime.avatar` for inputs and outputs."""
    graph = GraphBuilder("rnd_avatar")
    count, joints = baked.log_weights.shape
    others = joints - 1
    window = graph.input("pose_window", (config.window_poses, others, 6))
    velocity = graph.input("joint_velocity", (others, 3))
    bones = graph.input("bone_transforms", (joints, 3, 4))
    bones = graph.reshape(bones, (joints, 12), "bones_flat")

    with graph.scope("pose"):
        last = graph.op(
            "Gather", window, graph.constant("last", np.int64(config.window_poses - 1)), name="now", axis=0
        )
        flat = graph.reshape(last, (1, 6 * others), "now_flat")
    with graph.scope("skinning"):
        logits = _skinning(graph, baked, config, window, velocity)
    with graph.scope("offsets"):
        offsets = _mlp(graph, baked.offsets, flat, None)
    with graph.scope("visibility"):
        visibility = _mlp(graph, baked.visibility, flat, _root_normals(graph, baked, bones))

    with graph.scope("interpolate"):
        fields = graph.op("Concat", logits, offsets, visibility, name="node_fields", axis=1)
        fields = _interpolate(graph, baked, fields)
        parts = {"weight_logits": joints, "offset": 3, "turn": 3, "visibility": 16}
        logits, offset, turn, visibility = graph.split(fields, parts, axis=1)
    with graph.scope("pose_gaussians"):
        weights = graph.op("Add", logits, graph.constant("log_template", baked.log_weights), name="logits")
        weights = graph.op("Softmax", weights, name="weights", axis=1)
        blend = graph.op("MatMul", weights, bones, name="blend")  # [N, 12], rows of [A_R | A_T]
        means = _means(graph, baked, config, offset, blend)
        covariances = _covariances(graph, baked, turn, blend)
        normals = _transform_normals(graph, blend, baked.normals)

    graph.output("means", means, (count, 3))
    graph.output("covariances", covariances, (count, 6))
    graph.output("normals", normals, (count, 3))
    graph.output("visibility", visibility, (count, 16))
    graph.output("skinning_weights", weights, (count, joints))
    for name, values in (
        ("opacities", baked.opacities),
        ("albedo", baked.albedo),
        ("roughness", baked.roughness),
    ):
        graph.output(name, graph.constant(f"static/{name}", values), values.shape)
    return graph.model(metadata, PRODUCER)


def _skinning(
    graph: GraphBuilder, baked: BakedAvatar, config: ModelConfig, window: str, velocity: str
) -> str:
    """Δ logits [M, J]; zeros where the avatar is trained with static skinning."""
    nodes, joints = baked.node_weights.shape
    if not config.dynamic_skinning:
        return graph.constant("static_logits", np.zeros((nodes, joints)))
    others = joints - 1
    with graph.scope("temporal"):
        by_joint = graph.op("Transpose", window, name="by_joint", perm=[1, 0, 2])
        tokens = graph.reshape(by_joint, (others, 6 * config.window_poses), "tokens")
        temporal = _attention(graph, baked.temporal, tokens)
    with graph.scope("spatial"):
        scaled = graph.op("Mul", velocity, graph.constant("scale", np.float32(VELOCITY_SCALE)), name="scaled")
        spatial = _attention(graph, baked.spatial, graph.op("Tanh", scaled, name="tokens"))
    merged = graph.op(
        "Add", temporal, graph.constant("position_part", baked.merge_first), name="merge_temporal"
    )
    merged = graph.op("Relu", graph.op("Add", merged, spatial, name="merge_spatial"), name="merged")
    w = baked.skinning
    hidden = graph.op(
        "Relu", graph.linear(merged, w["hidden.weight"], w["hidden.bias"], "hidden"), name="hidden_relu"
    )
    return graph.linear(hidden, w["logits.weight"], w["logits.bias"], "logits")


def _attention(graph: GraphBuilder, baked: BakedAttention, tokens: str) -> str:
    """Self-attention of the joints, then cross-attention of the nodes: [J−1, inputs] → [M, width]."""
    w, heads = baked.module, baked.heads
    width = w["query.weight"].shape[0]
    embedded = graph.linear(tokens, w["embed.weight"], w["embed.bias"], "embed")
    embedded = graph.op("Add", embedded, graph.constant("joint_embedding", w["joint"]), name="with_joint")
    normed = graph.op(
        "LayerNormalization", embedded, graph.constant("norm_scale", w["norm.weight"]),
        graph.constant("norm_bias", w["norm.bias"]), name="norm", axis=-1, epsilon=LAYER_NORM_EPSILON,
    )  # fmt: skip
    qkv = graph.linear(normed, w["self_qkv.weight"], w["self_qkv.bias"], "self_qkv")
    query, key, value = graph.split(
        qkv, {"self_query": width, "self_key": width, "self_value": width}, axis=1
    )
    scale = graph.constant("self_scale", np.float32((width // heads) ** -0.5))
    query = graph.op("Mul", query, scale, name="self_query_scaled")
    joints = len(w["joint"])
    mixed = _attend(graph, _Tokens(key, value, heads, joints), query, w["self_out.weight"], "self")
    mixed = graph.op("Add", mixed, graph.constant("self_out_bias", w["self_out.bias"]), name="self_out")
    mixed = graph.op("Add", embedded, mixed, name="mixed")
    key_value = graph.linear(mixed, w["key_value.weight"], w["key_value.bias"], "key_value")
    key, value = graph.split(key_value, {"key": width, "value": width}, axis=1)
    query = graph.constant("query", baked.query)
    return _attend(graph, _Tokens(key, value, heads, joints), query, baked.out, "cross")


class _Tokens(NamedTuple):
    """Keys and values [J−1, width] of the joints, by name."""

    key: str
    value: str
    heads: int
    joints: int


def _attend(graph: GraphBuilder, tokens: _Tokens, query: str, out: Any, name: str) -> str:
    """Multi-head attention, all heads in two products: query [Q, width] → [Q, rows of ``out``]."""
    key, value, heads, others = tokens.key, tokens.value, tokens.heads, tokens.joints
    width = out.shape[1]
    head_of_row = np.repeat(np.arange(heads), others)  # rows of the stacked joints: head-major
    head_of_column = np.repeat(np.arange(heads), width // heads)
    mask = graph.constant(f"{name}_heads", (head_of_row[:, None] == head_of_column).astype(np.float32))
    keys = graph.op(
        "Mul",
        graph.op("Concat", *[key] * heads, name=f"{name}_keys_tiled", axis=0),
        mask,
        name=f"{name}_keys",
    )
    values = graph.op("Concat", *[value] * heads, name=f"{name}_values_tiled", axis=0)
    values = graph.op("Mul", values, mask, name=f"{name}_values")
    projected = graph.op("MatMul", values, graph.constant(f"{name}_out", out.T), name=f"{name}_values_out")
    scores = graph.op(
        "MatMul",
        query,
        graph.op("Transpose", keys, name=f"{name}_keys_t", perm=[1, 0]),
        name=f"{name}_scores",
    )
    scores = graph.reshape(scores, (-1, heads, others), f"{name}_scores_by_head")
    shares = graph.op("Softmax", scores, name=f"{name}_shares", axis=-1)
    shares = graph.reshape(shares, (-1, heads * others), f"{name}_shares_flat")
    return graph.op("MatMul", shares, projected, name=f"{name}_attended")


def _mlp(graph: GraphBuilder, baked: BakedMlp, pose: str, extra: str | None) -> str:
    """A :class:`rnd_trainer.encoders.PoseConditioned` → [M, outputs]."""
    w = baked.module
    code = graph.op("Relu", graph.linear(pose, w["code.weight"], w["code.bias"], "code"), name="code_relu")
    code = graph.op("MatMul", code, graph.constant("from_code", w["from_code.weight"].T), name="code_part")
    first = graph.op("Add", graph.constant("position_part", baked.first), code, name="with_pose")
    if extra is not None:
        part = graph.op(
            "MatMul", extra, graph.constant("from_extra", w["from_extra.weight"].T), name="extra_part"
        )
        first = graph.op("Add", first, part, name="with_extra")
    hidden = graph.linear(
        graph.op("Relu", first, name="first_relu"), w["hidden.weight"], w["hidden.bias"], "hidden"
    )
    return graph.linear(graph.op("Relu", hidden, name="hidden_relu"), w["out.weight"], w["out.bias"], "out")


def _root_normals(graph: GraphBuilder, baked: BakedAvatar, bones: str) -> str:
    """The nodes' normals [M, 3], posed by the template's weights, in the root's frame."""
    blend = graph.op(
        "MatMul", graph.constant("template_weights", baked.node_weights), bones, name="template_blend"
    )
    normals = _transform_normals(graph, blend, baked.node_normals)
    root = graph.op("Gather", bones, graph.constant("root", np.int64(0)), name="root_bone", axis=0)
    root = graph.reshape(root, (3, 4), "root_transform")
    columns = graph.constant("rotation_columns", np.array([0, 1, 2], np.int64))
    root = graph.op("Gather", root, columns, name="root_rotation", axis=1)
    return graph.op("MatMul", normals, root, name="root_normals")


def _interpolate(graph: GraphBuilder, baked: BakedAvatar, fields: str) -> str:
    """Σ_k weight_k · fields[neighbour_k]: [M, C] → [N, C]."""
    total = ""
    for k in range(baked.neighbours.shape[1]):
        rows = graph.constant(f"neighbour{k}", baked.neighbours[:, k])
        part = graph.op("Gather", fields, rows, name=f"gathered{k}", axis=0)
        weight = graph.constant(f"weight{k}", baked.neighbour_weights[:, k : k + 1])
        part = graph.op("Mul", part, weight, name=f"weighted{k}")
        total = graph.op("Add", total, part, name=f"sum{k}") if total else part
    return total


def _means(graph: GraphBuilder, baked: BakedAvatar, config: ModelConfig, offset: str, blend: str) -> str:
    """A_R (x_c + Δx) + A_T."""
    bound = graph.constant("max_offset", np.float32(config.max_offset))
    offset = graph.op("Mul", graph.op("Tanh", offset, name="offset_tanh"), bound, name="offset")
    points = graph.op("Add", graph.constant("points", baked.points), offset, name="points_offset")
    one = graph.constant("one", np.ones((len(baked.points), 1)))
    points = graph.op("Concat", points, one, name="points_homogeneous", axis=1)
    points = graph.reshape(points, (-1, 1, 4), "points_row")
    products = graph.op("Mul", graph.reshape(blend, (-1, 3, 4), "blend_3x4"), points, name="products")
    return graph.op(
        "ReduceSum", products, graph.constant("last_axis", np.array([2], np.int64)), name="means", keepdims=0
    )


def _covariances(graph: GraphBuilder, baked: BakedAvatar, turn: str, blend: str) -> str:
    """Upper triangle of F Fᵀ + floor², F = A_R · rotation(Δr) · R S."""
    factors = graph.constant("factors", baked.frames * baked.scales[:, None, :])
    turned = graph.op("MatMul", _small_rotation(graph, turn, len(baked.points)), factors, name="turned")
    linear = graph.reshape(
        graph.op("Gather", blend, _columns(graph, "linear", _LINEAR), name="linear9", axis=1),
        (-1, 3, 3),
        "linear",
    )
    posed = graph.op("MatMul", linear, turned, name="factors_posed")
    transposed = graph.op("Transpose", posed, name="factors_transposed", perm=[0, 2, 1])
    full = graph.reshape(
        graph.op("MatMul", posed, transposed, name="covariance_3x3"), (-1, 9), "covariance_9"
    )
    upper = graph.op(
        "Gather", full, _columns(graph, "upper", [0, 1, 2, 4, 5, 8]), name="covariance_6", axis=1
    )
    floor = THICKNESS_FLOOR**2 * np.array([1, 0, 0, 1, 0, 1])
    return graph.op("Add", upper, graph.constant("floor", floor), name="covariances")


def _small_rotation(graph: GraphBuilder, turn: str, count: int) -> str:
    """Rotations [N, 3, 3] of normalize(1, tanh(turn)/2): linear in the ten products of q with itself."""
    half = graph.constant("half", np.float32(0.5))
    vector = graph.op("Mul", graph.op("Tanh", turn, name="turn_tanh"), half, name="turn_half")
    q = graph.op(
        "Concat", graph.constant("real_part", np.ones((count, 1))), vector, name="q_unnormalised", axis=1
    )
    axis = graph.constant("component_axis", np.array([1], np.int64))
    q = graph.op("Div", q, graph.op("ReduceL2", q, axis, name="q_length", keepdims=1), name="q")
    first = graph.op("Gather", q, _columns(graph, "first", [i for i, _ in _PAIRS]), name="q_first", axis=1)
    second = graph.op("Gather", q, _columns(graph, "second", [j for _, j in _PAIRS]), name="q_second", axis=1)
    products = graph.op("Mul", first, second, name="q_products")
    matrix = graph.op(
        "MatMul", products, graph.constant("quaternion_to_matrix", _quaternion_to_matrix()), name="turn9"
    )
    return graph.reshape(matrix, (-1, 3, 3), "turn_rotation")


def _quaternion_to_matrix() -> Any:
    """[10, 9]: products of a unit quaternion's components (:data:`_PAIRS`) → rows of its rotation matrix."""
    rows = {
        0: {(0, 0): 1, (1, 1): 1, (2, 2): -1, (3, 3): -1}, 1: {(1, 2): 2, (0, 3): -2}, 2: {(1, 3): 2, (0, 2): 2},
        3: {(1, 2): 2, (0, 3): 2}, 4: {(0, 0): 1, (1, 1): -1, (2, 2): 1, (3, 3): -1}, 5: {(2, 3): 2, (0, 1): -2},
        6: {(1, 3): 2, (0, 2): -2}, 7: {(2, 3): 2, (0, 1): 2}, 8: {(0, 0): 1, (1, 1): -1, (2, 2): -1, (3, 3): 1},
    }  # fmt: skip
    matrix = np.zeros((len(_PAIRS), 9))
    for entry, terms in rows.items():
        for pair, factor in terms.items():
            matrix[_PAIRS.index(pair), entry] = factor
    return matrix


_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]
_LINEAR = [0, 1, 2, 4, 5, 6, 8, 9, 10]


def _columns(graph: GraphBuilder, name: str, columns: list[int]) -> str:
    return graph.constant(f"{name}_columns", np.array(columns, np.int64))


def _transform_normals(graph: GraphBuilder, blend: str, normals: Any) -> str:
    """Unit normals [N, 3]: (cofactor(A_R) + ε A_R) n, normalised; blend [N, 12]."""
    with graph.scope("normals"):
        row, column = np.divmod(np.arange(9), 3)

        def entries(rows: Any, columns: Any, name: str) -> str:
            return graph.op(
                "Gather", blend, _columns(graph, name, list(4 * (rows % 3) + columns % 3)), name=name, axis=1
            )

        plus = graph.op(
            "Mul", entries(row + 1, column + 1, "a"), entries(row + 2, column + 2, "b"), name="a_b"
        )
        minus = graph.op(
            "Mul", entries(row + 1, column + 2, "c"), entries(row + 2, column + 1, "d"), name="c_d"
        )
        cofactors = graph.op("Sub", plus, minus, name="cofactors")
        share = graph.constant("fallback", np.float32(NORMAL_FALLBACK))
        linear = graph.op("Mul", entries(row, column, "linear"), share, name="linear_share")
        mixed = graph.reshape(graph.op("Add", cofactors, linear, name="mixed9"), (-1, 3, 3), "mixed")
        rest = graph.constant("rest", np.asarray(normals)[:, None, :])
        turned = graph.op("Mul", mixed, rest, name="products")
        turned = graph.op(
            "ReduceSum",
            turned,
            graph.constant("last_axis", np.array([2], np.int64)),
            name="turned",
            keepdims=0,
        )
        length = graph.op(
            "ReduceL2",
            turned,
            graph.constant("vector_axis", np.array([1], np.int64)),
            name="length",
            keepdims=1,
        )
        length = graph.op(
            "Max", length, graph.constant("shortest", np.float32(NORMALIZE_FLOOR)), name="length_floor"
        )
        return graph.op("Div", turned, length, name="unit")
