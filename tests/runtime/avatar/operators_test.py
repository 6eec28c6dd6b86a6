"""Files made of anything but the exporter's operators, or of values that fill the memory, are refused unevaluated."""

from __future__ import annotations

import re
from pathlib import Path
from time import perf_counter

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from rnd_runtime.avatar.networks import Networks
from rnd_runtime.avatar.onnx_parts import OnnxFile
from rnd_runtime.avatar.operators import OPERATORS, check_operators
from rnd_runtime.core.errors import InputError

ROOT = Path(__file__).parents[3]
make = helper.make_node


def test_the_operators_are_those_that_the_exporter_writes():
    """Every operator's name in the exporter's sources, and no more."""
    texts = [path.read_text() for path in (ROOT / "export/rnd_export/build").glob("*.py")]
    written = {name for text in texts for name in re.findall(r'"([A-Z][A-Za-z0-9]+)"', text) if onnx.defs.has(name)}
    assert written == OPERATORS


def test_an_exported_avatar_passes(tiny_avatar):
    content = tiny_avatar.read_bytes()
    file = OnnxFile(content)
    assert {node.operator for node in file.nodes} <= OPERATORS
    check_operators(file, len(content))


def _external() -> onnx.TensorProto:
    tensor = onnx.TensorProto(name="outside", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "secret.bin"
    return tensor


def _numbers(name: str, value: object, kind: type = np.int64) -> onnx.TensorProto:
    return numpy_helper.from_array(np.asarray(value, kind), name)


def _graph(*nodes: onnx.NodeProto, constants: tuple[onnx.TensorProto, ...] = ()) -> onnx.GraphProto:
    out = helper.make_tensor_value_info("odd", TensorProto.FLOAT, None)
    return helper.make_graph(list(nodes), "inner", [], [out], list(constants))


ATTACKS = {
    "Loop": (
        [make("Loop", ["often", ""], ["odd"], body=_graph(make("Identity", ["x"], ["odd"])))],
        "graphs or tensors",
    ),
    "If with external data": (
        [make("If", ["yes"], ["odd"], then_branch=_graph(constants=(_external(),)), else_branch=_graph())],
        "graphs or tensors",
    ),
    "Constant of another file": ([make("Constant", [], ["odd"], value=_external())], "constants in another file"),
    "Constant": ([make("Constant", [], ["odd"], value=_numbers("", [1]))], "operators: .*got Constant"),
    "other domain": ([make("Gelu", ["big"], ["odd"], domain="com.microsoft")], "standard operators"),
    "RandomNormal": ([make("RandomNormal", [], ["odd"], shape=[4])], "operators: .*got RandomNormal"),
    "filled": ([make("ConstantOfShape", ["many"], ["odd"])], "value odd expands too far"),
    "outer product": ([make("Mul", ["column", "row"], ["odd"])], "value odd expands too far"),
    "matrix product": ([make("MatMul", ["column", "row"], ["odd"])], "value odd expands too far"),
    "gathered": ([make("Gather", ["row", "indices"], ["odd"])], "value odd expands too far"),
    "doubled": (
        [make("Concat", [f"d{k}" if k else "row", f"d{k}" if k else "row"], [f"d{k + 1}"], axis=1) for k in range(40)],
        "value d.* expands too far",
    ),
    "many": ([make("Mul", ["column", "short"], [f"m{k}"]) for k in range(100)], "value m.* expands too far"),
}
CONSTANTS = (
    _numbers("often", 2**62),
    _numbers("yes", True, np.bool_),
    _numbers("many", [30_000, 30_000]),
    _numbers("column", np.zeros((20_000, 1)), np.float32),
    _numbers("row", np.zeros((1, 20_000)), np.float32),
    _numbers("short", np.zeros((1, 200)), np.float32),
    _numbers("indices", np.zeros(10_000)),
)


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_are_refused_at_once(tiny_avatar, tmp_path, attack):
    nodes, reason = ATTACKS[attack]
    model = onnx.load(tiny_avatar)
    model.graph.initializer.extend(CONSTANTS)
    model.graph.node.extend(nodes)
    path = tmp_path / "odd.onnx"
    path.write_bytes(model.SerializeToString())
    started = perf_counter()
    with pytest.raises(InputError, match=rf"odd\.onnx: .*{reason}"):
        Networks.load(path)
    assert perf_counter() - started < 5


def test_shapes_are_those_of_onnx(tiny_avatar):
    """Every value's shape as onnx infers it."""
    from rnd_runtime.avatar.operators import _SHAPES, _Shapes

    model = onnx.shape_inference.infer_shapes(onnx.load(tiny_avatar), data_prop=True, strict_mode=True)
    wanted = {
        value.name: tuple(size.dim_value for size in value.type.tensor_type.shape.dim)
        for value in (*model.graph.value_info, *model.graph.output)
    }
    file = OnnxFile(tiny_avatar.read_bytes())
    shapes = _Shapes(file)
    for node in file.nodes:
        shapes.known.update(zip(node.outputs, _SHAPES[node.operator](node, shapes)))
    assert len(wanted) > 100
    assert {name: shapes.known[name] for name in wanted} == wanted
