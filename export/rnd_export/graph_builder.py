"""A thin writer of ONNX graphs: every node and tensor gets a name that reads well in Netron."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET = 18


class GraphBuilder:
    """Collects nodes and constants; values are referred to by their names.

    ``scope`` prefixes names ("skinning/temporal/keys"), so a reader of the graph sees where he is.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._scope: list[str] = []
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._names: set[str] = set()

    def scope(self, name: str) -> _Scope:
        """A context within which all names begin with ``name/``."""
        return _Scope(self._scope, name)

    def input(self, name: str, shape: tuple[int, ...]) -> str:
        """A float32 input of the graph."""
        self._inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        return name

    def output(self, name: str, value: str, shape: tuple[int, ...]) -> None:
        """Name ``value`` as a float32 output of the graph."""
        self._nodes.append(helper.make_node("Identity", [value], [name], name=f"output/{name}"))
        self._outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))

    def constant(self, name: str, value: Any) -> str:
        """A constant; float64 becomes float32, everything else keeps its type."""
        array: NDArray[Any] = np.asarray(value)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        full = self._unique(name)
        self._constants[full] = numpy_helper.from_array(np.ascontiguousarray(array), full)
        return full

    def op(self, kind: str, *inputs: str, name: str, **attributes: Any) -> str:
        """One node with one output, called ``name``."""
        full = self._unique(name)
        self._nodes.append(helper.make_node(kind, list(inputs), [full], name=full, **attributes))
        return full

    def split(self, value: str, sizes: dict[str, int], axis: int) -> list[str]:
        """``value`` cut along ``axis`` into parts named and sized by ``sizes``."""
        lengths = self.constant("part_sizes", np.array(list(sizes.values()), np.int64))
        outputs = [self._unique(part) for part in sizes]
        self._nodes.append(
            helper.make_node("Split", [value, lengths], outputs, name=self._unique("split"), axis=axis)
        )
        return outputs

    def reshape(self, value: str, shape: tuple[int, ...], name: str) -> str:
        """``value`` in another shape."""
        return self.op("Reshape", value, self.constant(f"{name}_shape", np.array(shape, np.int64)), name=name)

    def linear(self, value: str, weight: Any, bias: Any, name: str) -> str:
        """value [.., I] · weight [O, I]ᵀ + bias [O]."""
        product = self.op(
            "MatMul", value, self.constant(f"{name}_weight", np.asarray(weight).T), name=f"{name}_product"
        )
        return self.op("Add", product, self.constant(f"{name}_bias", bias), name=name)

    def model(self, metadata: dict[str, str], producer: str) -> onnx.ModelProto:
        """The checked model; its bytes depend on nothing but what was put in."""
        graph = helper.make_graph(
            self._nodes, self._name, self._inputs, self._outputs, list(self._constants.values())
        )
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name=producer
        )
        model.ir_version = 8  # of opset 18's time: the oldest runtimes that know the opset can read it
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
