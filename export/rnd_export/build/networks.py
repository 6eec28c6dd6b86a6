"""The networks of ``rnd_trainer.model.encoders`` as ONNX nodes, evaluated at the template's nodes.

What depends on a node's place alone is written as an expression of constants, which onnxruntime evaluates once
when it loads the file. Of the skinning's two cross-attentions that leaves two matrix products over all heads of
both at once: f_x [M, width] times the joints' keys [width, 2·heads·(J−1)], which stand block by block and have
the query's projection in them, and the shares times values that have everything up to the next layer in them.

Each head's joints are filled up to a multiple of eight with joints that get no share: a softmax of 24 takes a fifth
less than one of 23, whose last seven onnxruntime does one by one.
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
NO_SHARE = -1e9
"""a score beside which no other leaves a share"""


@dataclass(frozen=True)
class Networks:
    """Writes networks into ``graph``; weights are kept as ``storage``."""

    graph: GraphBuilder
    storage: Storage

    def encoded(self, codes: Any, frequencies: int) -> str:
        """Positional encoding [M, E] of codes [M, 3] m; constant."""
        graph = self.graph
        with graph.scope("nodes"):
            # always float32: the highest band turns a millimetre into 0.2 rad
            place = graph.constant("places", codes)
            bands = graph.constant("bands", np.pi * 2.0 ** np.arange(frequencies)[:, None])
            angles = graph.op(
                "Mul", graph.reshape(place, (-1, 1, 3), "places_row"), bands, name="angles"
            )  # [M, frequencies, 3]
            parts = [place]
            for kind in ("Sin", "Cos"):
                wave = graph.op(kind, angles, name=kind.lower())
                parts.append(graph.reshape(wave, (len(codes), 3 * frequencies), f"{kind.lower()}_flat"))
            return graph.op("Concat", *parts, name="encoded", axis=1)

    def skinning(self, baked: BakedSkinning, encoded: str, window: str, velocity: str) -> str:
        """Δ logits [M, J] from the window [d, J−1, 6] and the velocities [J−1, 3] rad/s."""
        graph, w = self.graph, baked.module
        others, heads = len(baked.temporal.module["joint"]), baked.heads
        filled = others + -others % LANES
        f_x = self._position(encoded, w)
        with graph.scope("temporal"):
            tokens = graph.op("Transpose", window, name="by_joint", perm=[1, 0, 2])
            tokens = graph.reshape(tokens, (others, -1), "tokens")
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
        scores = graph.op("Add", scores, bias, name="cross_scores")  # [M, 2·heads·filled]
        shares = graph.reshape(scores, (-1, 2 * heads, filled), "scores_by_head")
        shares = graph.op("Softmax", shares, name="shares", axis=-1)
        shares = graph.reshape(shares, (-1, 2 * heads * filled), "shares_flat")
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

        Shapes [heads·filled, width], [heads·filled] and [heads·filled, O]; rows head by head, each head's J−1 joints
        and then those that fill it up.
        """
        graph, w = self.graph, baked.module
        others, width = w["joint"].shape
        filling = -others % LANES
        embedded = self._layer(tokens, w, "embed")
        embedded = graph.op("Add", embedded, graph.constant("joint_embedding", w["joint"]), name="with_joint")
        normed = graph.op(
            "LayerNormalization",
            embedded,
            graph.constant("norm_scale", w["norm.weight"]),
            graph.constant("norm_bias", w["norm.bias"]),
            name="norm",
            axis=-1,
            epsilon=LAYER_NORM_EPSILON,
        )
        parts = {"self_query": width, "self_key": width, "self_value": width}
        query, key, value = graph.split(self._layer(normed, w, "self_qkv"), parts, axis=1)
        scale = graph.constant("self_scale", np.float32((width // heads) ** -0.5))
        query = graph.op("Mul", query, scale, name="self_query_scaled")
        keys = graph.op("Transpose", self._by_head(key, heads, others, width), name="self_keys_t", perm=[1, 0])
        shares = graph.op("MatMul", query, keys, name="self_scores")
        shares = graph.reshape(shares, (-1, heads, others), "self_scores_by_head")
        shares = graph.op("Softmax", shares, name="self_shares", axis=-1)
        shares = graph.reshape(shares, (-1, heads * others), "self_shares_flat")
        mixed = graph.op("MatMul", shares, self._by_head(value, heads, others, width), name="self_attended")
        mixed = graph.op("Add", embedded, self._layer(mixed, w, "self_out"), name="mixed")
        key, value = graph.split(self._layer(mixed, w, "key_value"), {"key": width, "value": width}, axis=1)
        if filling:
            zeros = graph.filled("filling", (filling, width), 0.0)
            key = graph.op("Concat", key, zeros, name="filled_key", axis=0)
            value = graph.op("Concat", value, zeros, name="filled_value", axis=0)
        keys = self._by_head(key, heads, others + filling, width)
        values = self._product(self._by_head(value, heads, others + filling, width), baked.out, "values_out")
        bias = graph.op("MatMul", keys, graph.constant("query_bias", baked.query_bias), name="keys_bias")
        if filling:
            unshared = np.tile(np.repeat([0.0, NO_SHARE], [others, filling]), heads)
            bias = graph.op("Add", bias, graph.constant("unshared", unshared), name="filled_bias")
        query = self.graph.stored("query", baked.query, self.storage)
        return graph.op("MatMul", keys, query, name="keys_in"), bias, values

    def _by_head(self, tokens: str, heads: int, others: int, width: int) -> str:
        """[others, width] → [heads·others, width]: once for each head, zero in the columns of the other heads."""
        head_of_row = np.repeat(np.arange(heads), others)
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
