"""The networks of ``rnd_trainer.model.encoders`` as ONNX nodes, evaluated at the template's nodes.

Expressions of a node's position alone are constant, and folded by onnxruntime at load. Of the two cross-attentions of
skinning remain two matrix products over all heads of both: f_x [M, width] times the joints' keys
[width, 2·heads·(J−1)], which contain the query projection, and attention weights times values that contain everything
up to the next layer.

Each head's joints are padded to a multiple of eight: a softmax of 24 takes a fifth less time than one of 23.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rnd_export.bake import BakedAttention, BakedSkinning
from rnd_trainer.model.encoders import VELOCITY_SCALE

from .builder import GraphBuilder, Storage

LAYER_NORM_EPSILON = 1e-5
LANES = 8
NO_SHARE = -1e9  # score of a padding joint


@dataclass(frozen=True)
class Networks:
    """Writes networks into ``graph``; weights are stored as ``storage``."""

    graph: GraphBuilder
    storage: Storage

    def encoded(self, codes: Any, frequencies: int) -> str:
        """Positional encoding [M, E] of codes [M, 3] m; constant."""
        graph = self.graph
        with graph.scope("nodes"):
            position = graph.constant("positions", codes)  # float32: 1 mm is 0.2 rad in the highest band
            bands = graph.constant("bands", np.pi * 2.0 ** np.arange(frequencies)[:, None])
            row = graph.reshape(position, (-1, 1, 3), "positions_row")
            angles = graph.op("Mul", row, bands, name="angles")  # [M, frequencies, 3]
            parts = [position]
            for kind in ("Sin", "Cos"):
                wave = graph.op(kind, angles, name=kind.lower())
                parts.append(graph.reshape(wave, (len(codes), 3 * frequencies), f"{kind.lower()}_flat"))
            return graph.op("Concat", *parts, name="encoded", axis=1)

    def skinning(self, baked: BakedSkinning, encoded: str, window: str, velocity: str) -> str:
        """Δ logits [M, J] from the window [d, J−1, 6] and the velocities [J−1, 3] rad/s."""
        graph, w = self.graph, baked.module
        joints, heads = len(baked.temporal.module["joint"]), baked.heads
        padded = joints + -joints % LANES
        f_x = self._position(encoded, w)
        with graph.scope("temporal"):
            tokens = graph.op("Transpose", window, name="by_joint", perm=[1, 0, 2])
            tokens = graph.reshape(tokens, (joints, -1), "tokens")
            keys_t, bias_t, values_t = self._joints(baked.temporal, tokens, heads)
        with graph.scope("spatial"):
            scaled = graph.op("Mul", velocity, graph.constant("scale", np.float32(VELOCITY_SCALE)), name="scaled")
            tokens = graph.op("Tanh", scaled, name="tokens")
            keys_s, bias_s, values_s = self._joints(baked.spatial, tokens, heads)
        keys = graph.op("Concat", keys_t, keys_s, name="keys", axis=0)
        keys = graph.op("Transpose", keys, name="keys_t", perm=[1, 0])
        values = graph.op("Concat", values_t, values_s, name="values", axis=0)
        scores = graph.op("MatMul", f_x, keys, name="scores_product")
        bias = graph.op("Concat", bias_t, bias_s, name="scores_bias", axis=0)
        scores = graph.op("Add", scores, bias, name="cross_scores")  # [M, 2·heads·padded]
        shares = graph.reshape(scores, (-1, 2 * heads, padded), "scores_by_head")
        shares = graph.op("Softmax", shares, name="shares", axis=-1)
        shares = graph.reshape(shares, (-1, 2 * heads * padded), "shares_flat")
        attended = graph.op("MatMul", shares, values, name="attended")
        position_part = self._linear(f_x, baked.merge, baked.merge_bias, "position_part")
        merged = graph.op("Relu", graph.op("Add", attended, position_part, name="merge"), name="merged")
        hidden = self._layer(merged, w, "hidden")
        return self._layer(graph.op("Relu", hidden, name="hidden_relu"), w, "logits")

    def conditioned(self, w: dict[str, Any], encoded: str, pose: str, extra: str | None) -> str:
        """A ``rnd_trainer.model.encoders.PoseConditioned`` → [M, outputs]."""
        graph = self.graph
        position = self._position(encoded, w)
        first = self._layer(position, w, "from_position")
        code = graph.op("Relu", self._layer(pose, w, "code"), name="code_relu")
        code = self._product(code, w["from_code.weight"], "code_part")
        first = graph.op("Add", first, code, name="with_pose")
        if extra is not None:
            part = self._product(extra, w["from_extra.weight"], "extra_part")
            first = graph.op("Add", part, first, name="with_extra")
        hidden = self._layer(graph.op("Relu", first, name="first_relu"), w, "hidden")
        return self._layer(graph.op("Relu", hidden, name="hidden_relu"), w, "out")

    def _joints(self, baked: BakedAttention, tokens: str, heads: int) -> tuple[str, str, str]:
        """Self-attention of the joint tokens [J−1, inputs]; keys, scores' bias and values for the nodes.

        Shapes [P, width], [P] and [P, O] with P = heads·padded; of each head J−1 joints, then its padding.
        """
        graph, w = self.graph, baked.module
        joints, width = w["joint"].shape
        padding = -joints % LANES
        embedded = self._layer(tokens, w, "embed")
        embedded = graph.op("Add", embedded, graph.constant("joint_embedding", w["joint"]), name="with_joint")
        affine = graph.constant("norm_scale", w["norm.weight"]), graph.constant("norm_bias", w["norm.bias"])
        options = {"axis": -1, "epsilon": LAYER_NORM_EPSILON}
        normed = graph.op("LayerNormalization", embedded, *affine, name="norm", **options)
        parts = {"self_query": width, "self_key": width, "self_value": width}
        query, key, value = graph.split(self._layer(normed, w, "self_qkv"), parts, axis=1)
        scale = graph.constant("self_scale", np.float32((width // heads) ** -0.5))
        query = graph.op("Mul", query, scale, name="self_query_scaled")
        keys = graph.op("Transpose", self._by_head(key, heads, joints, width), name="self_keys_t", perm=[1, 0])
        shares = graph.op("MatMul", query, keys, name="self_scores")
        shares = graph.reshape(shares, (-1, heads, joints), "self_scores_by_head")
        shares = graph.op("Softmax", shares, name="self_shares", axis=-1)
        shares = graph.reshape(shares, (-1, heads * joints), "self_shares_flat")
        mixed = graph.op("MatMul", shares, self._by_head(value, heads, joints, width), name="self_attended")
        mixed = graph.op("Add", embedded, self._layer(mixed, w, "self_out"), name="mixed")
        key, value = graph.split(self._layer(mixed, w, "key_value"), {"key": width, "value": width}, axis=1)
        if padding:
            zeros = graph.filled("filling", (padding, width), 0.0)
            key = graph.op("Concat", key, zeros, name="padded_key", axis=0)
            value = graph.op("Concat", value, zeros, name="padded_value", axis=0)
        keys = self._by_head(key, heads, joints + padding, width)
        values = self._product(self._by_head(value, heads, joints + padding, width), baked.out, "values_out")
        bias = graph.op("MatMul", keys, graph.constant("query_bias", baked.query_bias), name="keys_bias")
        if padding:
            unshared = np.tile(np.repeat([0.0, NO_SHARE], [joints, padding]), heads)
            bias = graph.op("Add", bias, graph.constant("unshared", unshared), name="padded_bias")
        query = self.graph.stored("query", baked.query, self.storage)
        return graph.op("MatMul", keys, query, name="keys_in"), bias, values

    def _by_head(self, tokens: str, heads: int, joints: int, width: int) -> str:
        """[joints, width] → [heads·joints, width]: a copy per head, zero in the columns of other heads."""
        head_of_row = np.repeat(np.arange(heads), joints)
        head_of_column = np.repeat(np.arange(heads), width // heads)
        mask = self.graph.constant("heads", (head_of_row[:, None] == head_of_column).astype(np.float32))
        tiled = self.graph.op("Concat", *[tokens] * heads, name="tiled", axis=0)
        return self.graph.op("Mul", tiled, mask, name="by_head")

    def _position(self, encoded: str, w: dict[str, Any]) -> str:
        """f_x [M, width]; constant."""
        with self.graph.scope("position"):
            value = self._linear(encoded, w["position.hidden.weight"], w["position.hidden.bias"], "hidden")
            value = self.graph.op("Relu", value, name="hidden_relu")
            value = self._linear(value, w["position.out.weight"], w["position.out.bias"], "out")
            return self.graph.op("Relu", value, name="f_x")

    def _layer(self, value: str, w: dict[str, Any], name: str) -> str:
        return self._linear(value, w[f"{name}.weight"], w[f"{name}.bias"], name)

    def _linear(self, value: str, weight: Any, bias: Any, name: str) -> str:
        """value [.., I] · weight [O, I]ᵀ + bias [O]."""
        product = self._product(value, weight, f"{name}_product")
        return self.graph.op("Add", product, self.graph.constant(f"{name}_bias", bias), name=name)

    def _product(self, value: str, weight: Any, name: str) -> str:
        stored = self.graph.stored(f"{name}_weight", weight, self.storage)
        transposed = self.graph.op("Transpose", stored, name=f"{name}_weight_t", perm=[1, 0])
        return self.graph.op("MatMul", value, transposed, name=name)
