"""The constants of an avatar's Gaussians in the rest pose, stored in as few bytes as their precision allows."""

from __future__ import annotations

from typing import Any

import numpy as np
from onnx import TensorProto

from rnd_export.bake import BakedAvatar
from rnd_runtime.avatar.file import Precision
from rnd_trainer.model.skinning import NORMAL_FALLBACK, THICKNESS_FLOOR

from .builder import GraphBuilder, Storage

STORAGE: dict[Precision, tuple[Storage, Storage, Storage]] = {
    "f32": ("f32", "f32", "f32"),
    "f16": ("f16", "f32", "f16"),
    "int8": ("u8", "u16", "f16"),
}
"""storage of most constants, of lengths, and of the networks"""

SMALLEST_LOG = 1e-4  # log weights closer than this to their row's minimum are stored as the minimum


class RestConstants:
    """Constants by name, and outputs of the graph for players that pose by themselves (``avatar.file``)."""

    def __init__(self, graph: GraphBuilder, baked: BakedAvatar, precision: Precision) -> None:
        self._graph = graph
        fine, lengths, networks = STORAGE[precision]
        middle: Storage = "u16" if precision == "int8" else fine
        self._names: dict[str, str] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        count = len(baked.points)
        for name, values, storage in (
            ("rest_points", baked.points, lengths),
            ("rest_factors", baked.factors.reshape(count, 9), fine),
            ("rest_normals", baked.normals, fine),
            ("rest_limbs", np.column_stack([baked.limb_axes, baked.limb_levers, baked.limb_shares]), middle),
            ("neighbour_weights", baked.neighbour_weights, fine),
            ("opacities", baked.opacities, fine),
            ("albedo", baked.albedo, fine),
            ("roughness", baked.roughness, fine),
        ):
            self._add(name, self._stored(name, values, storage), values.shape)
        self._add("log_template", self._log_template(baked.weights, networks), baked.weights.shape)
        self._add("neighbours", graph.packed("rest/neighbours", baked.neighbours), baked.neighbours.shape)
        limits = np.array([baked.max_offset, THICKNESS_FLOOR**2, NORMAL_FALLBACK])
        self._add("posing_limits", graph.constant("rest/posing_limits", limits), (3,))

    def __getitem__(self, name: str) -> str:
        return self._names[name]

    def by_component(self, name: str, shape: tuple[int, ...] = (3,)) -> str:
        """The constant ``name``, [N, C] or [N], as [*shape, N]."""
        graph = self._graph
        rows = graph.reshape(self[name], (self._shapes[name][0], -1), f"rest/{name}_rows")
        columns = graph.op("Transpose", rows, name=f"rest/{name}_columns", perm=[1, 0])
        return graph.reshape(columns, (*shape, -1), f"rest/{name}_by_component")

    def to_outputs(self) -> None:
        """Make outputs of all constants; to be called last."""
        for name, shape in self._shapes.items():
            kind = TensorProto.INT32 if name == "neighbours" else TensorProto.FLOAT
            self._graph.output(name, self[name], shape, kind)

    def _add(self, name: str, value: str, shape: tuple[int, ...]) -> None:
        self._names[name], self._shapes[name] = value, shape

    def _stored(self, name: str, values: Any, storage: Storage) -> str:
        """``values`` [N, …]; quantisation is per component."""
        graph, name = self._graph, f"rest/{name}"
        if storage in ("f32", "f16"):
            return graph.stored(name, values, storage)
        columns = graph.stored(f"{name}_columns", values.reshape(len(values), -1).T, storage)
        rows = graph.op("Transpose", columns, name=f"{name}_unpacked", perm=[1, 0])
        return graph.reshape(rows, values.shape, name)

    def _log_template(self, weights: Any, storage: Storage) -> str:
        """log W_template [N, J], each row less its minimum; stored sparsely, indices as differences."""
        graph = self._graph
        with graph.scope("rest/template"):
            logs = np.log(weights)
            flat = (logs - logs.min(axis=1, keepdims=True)).reshape(-1)
            entries = np.flatnonzero(flat > SMALLEST_LOG)
            if len(entries) == 0:  # one joint, or equal weights
                return graph.reshape(graph.filled("zeros", (flat.size,), 0.0), weights.shape, "log_template")
            indices = graph.packed("steps", np.diff(entries, prepend=0))
            indices = graph.op("CumSum", indices, graph.constant("step_axis", np.int64(0)), name="indices")
            values = graph.stored("log_weights", flat[entries], storage)
            zeros = graph.filled("zeros", (flat.size,), 0.0)
            filled = graph.op("ScatterElements", zeros, indices, values, name="filled", axis=0)
            return graph.reshape(filled, weights.shape, "log_template")
