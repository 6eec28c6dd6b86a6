"""A writer of ONNX graphs with readable names of nodes and tensors."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET = 18

Storage = Literal["f32", "f16", "u16", "u8"]


class GraphBuilder:
    """Collects nodes and constants; values are identified by their names."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._scope: list[str] = []
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._names: set[str] = set()

    def scope(self, name: str) -> _Scope:
        """A context that prefixes names with ``name/``."""
        return _Scope(self._scope, name)

    def input(self, name: str, shape: tuple[int, ...]) -> str:
        """A float32 input of the graph."""
        self._inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        return name

    def output(self, name: str, value: str, shape: tuple[int, ...], kind: int = TensorProto.FLOAT) -> None:
        """Name ``value`` as an output of the graph."""
        if value in self._constants:
            self._nodes.append(helper.make_node("Identity", [value], [name], name=f"output/{name}"))
        else:  # renamed, since an Identity would copy the value in every frame
            for node in self._nodes:
                for ends in (node.input, node.output):
                    ends[:] = [name if end == value else end for end in ends]
        self._outputs.append(helper.make_tensor_value_info(name, kind, shape))

    def constant(self, name: str, value: Any) -> str:
        """A constant; float64 becomes float32."""
        array: NDArray[Any] = np.asarray(value)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        full = self._unique(name)
        self._constants[full] = numpy_helper.from_array(np.asarray(array, order="C"), full)
        return full

    def stored(self, name: str, value: Any, storage: Storage) -> str:
        """A float32 constant stored in fewer bits, unpacked by onnxruntime at load.

        ``u8`` and ``u16`` quantise each row along the first axis of ``value`` over its range.
        """
        array = np.asarray(value, np.float64)
        if storage == "f32":
            return self.constant(name, array)
        if storage == "f16":
            packed = self.constant(f"{name}_f16", array.astype(np.float16))
            return self.op("Cast", packed, name=name, to=TensorProto.FLOAT)
        steps, kind = (255, np.uint8) if storage == "u8" else (65535, np.uint16)
        others = tuple(range(1, array.ndim))
        low = array.min(axis=others, keepdims=True)
        step = np.maximum((array.max(axis=others, keepdims=True) - low) / steps, 1e-12)
        packed = self.constant(f"{name}_{storage}", np.round((array - low) / step).astype(kind))
        counts = self.op("Cast", packed, name=f"{name}_counts", to=TensorProto.FLOAT)
        scaled = self.op("Mul", counts, self.constant(f"{name}_step", step), name=f"{name}_spread")
        return self.op("Add", scaled, self.constant(f"{name}_low", low), name=name)

    def packed(self, name: str, value: Any) -> str:
        """An int32 constant of non-negative numbers in the smallest sufficient integer type."""
        array: NDArray[Any] = np.asarray(value)
        smallest = next(kind for kind in (np.uint8, np.uint16, np.int32) if array.max() <= np.iinfo(kind).max)
        packed = self.constant(f"{name}_packed", array.astype(smallest))
        return self.op("Cast", packed, name=name, to=TensorProto.INT32)

    def op(self, kind: str, *inputs: str, name: str, **attributes: Any) -> str:
        """One node with one output, called ``name``."""
        full = self._unique(name)
        self._nodes.append(helper.make_node(kind, list(inputs), [full], name=full, **attributes))
        return full

    def split(self, value: str, sizes: dict[str, int], axis: int) -> list[str]:
        """``value`` cut along ``axis`` into parts named and sized by ``sizes``."""
        lengths = self.constant("part_sizes", np.array(list(sizes.values()), np.int64))
        outputs = [self._unique(part) for part in sizes]
        self._nodes.append(helper.make_node("Split", [value, lengths], outputs, name=self._unique("split"), axis=axis))
        return outputs

    def rows(self, value: str, rows: Any, name: str, axis: int = 0) -> str:
        return self.op("Gather", value, self.constant(f"{name}_rows", np.asarray(rows, np.int64)), name=name, axis=axis)

    def sum(self, value: str, axis: int, name: str, *, keepdims: bool = False) -> str:
        axes = self.constant(f"{name}_axis", np.array([axis], np.int64))
        return self.op("ReduceSum", value, axes, name=name, keepdims=int(keepdims))

    def reshape(self, value: str, shape: tuple[int, ...], name: str) -> str:
        return self.op("Reshape", value, self.constant(f"{name}_shape", np.array(shape, np.int64)), name=name)

    def filled(self, name: str, shape: tuple[int, ...], value: float) -> str:
        """A float32 constant of equal values."""
        size = self.constant(f"{name}_shape", np.array(shape, np.int64))
        filler = helper.make_tensor("value", TensorProto.FLOAT, [1], [value])
        return self.op("ConstantOfShape", size, name=name, value=filler)

    def model(self, metadata: dict[str, str], producer: str) -> onnx.ModelProto:
        """The checked model; its bytes are deterministic."""
        graph = helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, list(self._constants.values()))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name=producer)
        model.ir_version = 8  # the oldest with opset 18
        helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model

    def _unique(self, name: str) -> str:
        full = stem = "/".join([*self._scope, name])
        count = 2
        while full in self._names:
            full, count = f"{stem}_{count}", count + 1
        self._names.add(full)
        return full


class _Scope:
    def __init__(self, stack: list[str], name: str) -> None:
        self._stack, self._scope = stack, name

    def __enter__(self) -> None:
        self._stack.append(self._scope)

    def __exit__(self, *_: object) -> None:
        self._stack.pop()
