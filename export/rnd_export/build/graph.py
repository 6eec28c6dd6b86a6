"""The avatar's graph: the mathematics of ``rnd_trainer.model.model``, arranged for onnxruntime on a CPU."""

from __future__ import annotations

import numpy as np
import onnx

from rnd_export.bake import BakedAvatar
from rnd_runtime.avatar.file import Precision
from rnd_runtime.shading.sh import SH_COUNT
from rnd_trainer.model.template import NEIGHBOURS

from .builder import GraphBuilder
from .networks import Networks
from .posing import Posing
from .rest import STORAGE, RestConstants

PRODUCER = "rnd-avatar"


def build_model(baked: BakedAvatar, precision: Precision, poses: int, metadata: dict[str, str]) -> onnx.ModelProto:
    """The avatar as an ONNX model; see ``rnd_runtime.avatar.file`` for inputs and outputs."""
    graph = GraphBuilder("rnd_avatar")
    count, joints = baked.weights.shape
    window = graph.input("pose_window", (poses, joints - 1, 6))
    velocity = graph.input("joint_velocity", (joints - 1, 3))
    bones = graph.input("bone_transforms", (joints, 3, 4))
    rest = RestConstants(graph, baked, precision)

    networks = Networks(graph, STORAGE[precision][2])
    sizes = {"node_logits": joints, "node_offsets": 6, "node_visibility": len(baked.visibility["out.bias"])}
    fields = _node_fields(graph, baked, rest, (window, velocity, bones), networks)
    with graph.scope("interpolate"):
        parts = _interpolated(graph, fields, sizes, rest["neighbours"], rest["neighbour_weights"])
        visibility = _padded(graph, parts["node_visibility"], count, SH_COUNT - sizes["node_visibility"])
    with graph.scope("pose_gaussians"):
        logits = rest["log_template"]
        if "node_logits" in parts:
            logits = graph.op("Add", parts["node_logits"], logits, name="logits")
        weights = graph.op("Softmax", logits, name="weights", axis=1)
        posed = _posed(graph, baked, rest, (parts["node_offsets"], weights, bones))

    for name, value in zip(("means", "covariances", "normals"), posed):
        graph.output(name, value, (count, 6 if name == "covariances" else 3))
    graph.output("visibility", visibility, (count, SH_COUNT))
    graph.output("skinning_weights", weights, (count, joints))
    for name, value in fields.items():
        graph.output(name, value, (len(baked.codes), sizes[name]))
    rest.to_outputs()
    return graph.model(metadata, PRODUCER)


def _node_fields(
    graph: GraphBuilder, baked: BakedAvatar, rest: RestConstants, inputs: tuple[str, str, str], networks: Networks
) -> dict[str, str]:
    """Outputs of the networks at their nodes, by name; no logits for static skinning."""
    window, velocity, bones = inputs
    fields = {}
    encoded = networks.encoded(baked.codes, baked.frequencies)

    if baked.skinning is not None:
        with graph.scope("skinning"):
            sites, still = encoded, len(baked.codes) - baked.dynamic_nodes
            if still:
                sites = graph.rows(encoded, np.arange(baked.dynamic_nodes), "sites")
            logits = networks.skinning(baked.skinning, sites, window, velocity)
            if still:  # the last nodes have the template's weights
                zeros = graph.filled("static_logits", (still, baked.weights.shape[1]), 0.0)
                logits = graph.op("Concat", logits, zeros, name="padded_logits", axis=0)
            fields["node_logits"] = logits
    with graph.scope("pose"):
        now = graph.op("Gather", window, graph.constant("last", np.int64(-1)), name="now", axis=0)
        now = graph.reshape(now, (1, -1), "now_flat")
    with graph.scope("offsets"):
        fields["node_offsets"] = networks.conditioned(baked.offsets, encoded, now, None)
    with graph.scope("visibility"):
        normals = _root_normals(graph, baked, rest, bones)
        fields["node_visibility"] = networks.conditioned(baked.visibility, encoded, now, normals)
    return fields


def _posed(
    graph: GraphBuilder, baked: BakedAvatar, rest: RestConstants, values: tuple[str, str, str]
) -> tuple[str, str, str]:
    """Means [N, 3], covariances [N, 6] and normals [N, 3] from offsets [N, 6], weights [N, J] and bones [J, 3, 4]."""
    offsets, weights, bones = values
    posing = Posing(graph)
    blend = posing.blend(weights, bones)
    linear = posing.linear(blend)
    cofactors = posing.cofactors(linear)
    limbs = rest.by_component("rest_limbs", (7,))
    axes, levers, shares = graph.split(limbs, {"limb_axes": 3, "limb_levers": 3, "limb_shares": 1}, axis=0)
    excess, widened = posing.widened(linear, cofactors, axes, shares)
    offsets = graph.op("Transpose", offsets, name="offsets_by_component", perm=[1, 0])
    offset, rotation = graph.split(graph.op("Tanh", offsets, name="bounded"), {"offset": 3, "rotation": 3}, axis=0)
    offset = graph.op("Mul", offset, graph.constant("max_offset", np.float32(baked.max_offset)), name="offset_m")
    points = graph.op("Add", rest.by_component("rest_points"), offset, name="points_offset")
    points = posing.outwards(points, excess, levers)
    normals = rest.by_component("rest_normals")
    normals = posing.normals(linear, cofactors, posing.widened_normals(normals, excess, axes))
    rotated = posing.multiply(
        posing.small_rotation(rotation, len(baked.points)), rest.by_component("rest_factors", (3, 3)), "rotated"
    )
    covariances = posing.covariances(posing.multiply(widened, rotated, "posed"))
    return posing.points(blend, linear, points), covariances, posing.by_gaussian(normals, "normals")


def _root_normals(graph: GraphBuilder, baked: BakedAvatar, rest: RestConstants, bones: str) -> str:
    """Normals of the nodes [M, 3], posed by the template's weights, in the root's frame."""
    posing = Posing(graph)
    weights = graph.rows(rest["log_template"], baked.node_rows, "nodes")
    weights = graph.op("Softmax", weights, name="weights", axis=1)
    root = graph.rows(graph.rows(bones, [0], "root_bone"), [0, 1, 2], "root_columns", axis=2)
    root = graph.reshape(root, (3, 3), "root")
    # Rᵀ B_j before blending: J products instead of one per node
    to_root = graph.op("Transpose", root, name="to_root", perm=[1, 0])
    in_root = graph.op("MatMul", to_root, bones, name="bones_in_root")
    linear = posing.linear(posing.blend(weights, in_root))
    normals = graph.rows(rest.by_component("rest_normals"), baked.node_rows, "rest_normals", axis=1)
    return posing.by_gaussian(posing.normals(linear, posing.cofactors(linear), normals), "root_normals")


def _interpolated(
    graph: GraphBuilder, fields: dict[str, str], sizes: dict[str, int], neighbours: str, weights: str
) -> dict[str, str]:
    """Σ_k weight_k · field[neighbour_k] of each field [m, size], by name: [n, size] for n rows of neighbours."""
    joined, result = graph.op("Concat", *fields.values(), name="fields", axis=1), ""
    for k in range(NEIGHBOURS):
        row = graph.op("Gather", neighbours, graph.constant(f"k{k}", np.int64(k)), name=f"neighbour{k}", axis=1)
        weight = graph.rows(weights, [k], f"weight{k}", axis=1)
        part = graph.op("Gather", joined, row, name=f"gathered{k}", axis=0)
        part = graph.op("Mul", part, weight, name=f"weighted{k}")
        result = graph.op("Add", result, part, name=f"sum{k}") if result else part
    return dict(zip(fields, graph.split(result, {name: sizes[name] for name in fields}, axis=1)))


def _padded(graph: GraphBuilder, visibility: str, count: int, missing: int) -> str:
    """[N, 16], zero for omitted degrees."""
    if not missing:
        return visibility
    zeros = graph.filled("no_visibility", (count, missing), 0.0)
    return graph.op("Concat", visibility, zeros, name="visibility16", axis=1)
