"""Cutting graphs out of ONNX files, against the onnx package."""

from __future__ import annotations

from time import perf_counter

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from rnd_runtime.avatar.onnx_parts import OnnxFile, _varint, number_field
from rnd_runtime.core.errors import InputError


def _model() -> onnx.ModelProto:
    """c = a + 1, d = 2 c, e = d b, f = (a constant), with names out of order among the constants."""
    constants = [
        numpy_helper.from_array(np.full((2, 3), 2, np.float32), "two"),
        numpy_helper.from_array(np.ones((2, 3), np.float32), "one"),
    ]
    nodes = [
        helper.make_node("Add", ["a", "one"], ["c"]),
        helper.make_node("Mul", ["c", "two"], ["d"]),
        helper.make_node("Mul", ["d", "b"], ["e"]),
        helper.make_node("Identity", ["two"], ["f"]),
    ]

    def value(name: str):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [2, 3])

    graph = helper.make_graph(nodes, "g", [value("a"), value("b")], [value("e"), value("f")], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 8
    helper.set_model_props(model, {"said": "ünïcode", "nothing": ""})
    return model


def _run(data: bytes, outputs: list[str], **inputs: np.ndarray) -> list[np.ndarray]:
    session = ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    assert [value.name for value in session.get_inputs()] == list(inputs)
    return session.run(outputs, inputs)


A, B = np.arange(6, dtype=np.float32).reshape(2, 3), np.full((2, 3), 5, np.float32)


def test_a_file_says_what_it_holds():
    file = OnnxFile(_model().SerializeToString())
    assert file.inputs == {"a": [2, 3], "b": [2, 3]} and file.outputs == {"e": [2, 3], "f": [2, 3]}
    assert file.metadata == {"said": "ünïcode", "nothing": ""}


def test_a_part_computes_its_outputs_and_nothing_else():
    file = OnnxFile(_model().SerializeToString())
    np.testing.assert_array_equal(_run(file.extract(["e"]), ["e"], a=A, b=B)[0], 2 * (A + 1) * B)
    inner, constant = _run(file.extract(["d", "f"]), ["d", "f"], a=A)  # an inner value; b is not asked for
    np.testing.assert_array_equal(inner, 2 * (A + 1))
    np.testing.assert_array_equal(constant, np.full((2, 3), 2))
    part = onnx.load_from_string(file.extract(["f"]))
    assert [node.output[0] for node in part.graph.node] == ["f"]
    assert [tensor.name for tensor in part.graph.initializer] == ["two"] and not part.graph.input
    assert {prop.key: prop.value for prop in part.metadata_props} == file.metadata


def test_an_output_that_nothing_makes_is_refused():
    model = _model()
    del model.graph.node[3]  # f stays among the graph's outputs
    file = OnnxFile(model.SerializeToString())
    assert file.outputs.keys() == {"e", "f"}
    with pytest.raises(InputError, match="graph outputs: expected something that makes f, got nothing"):
        file.extract(["e", "f"])


@pytest.mark.parametrize("length", [0, 1, 20, 150, -1])
def test_a_file_cut_short_is_refused(length):
    with pytest.raises(InputError, match="not a readable ONNX model"):
        OnnxFile(_model().SerializeToString()[:length])


@pytest.mark.parametrize("head", [b"", b"\x0a", b"\x08"])
def test_a_number_without_an_end_is_refused_at_its_tenth_byte(head):
    started = perf_counter()
    with pytest.raises(InputError, match="not a readable ONNX model"):
        OnnxFile(head + b"\xff" * 1_000_000)  # read to the end it is a number of 7 000 000 bits: ten seconds
    assert perf_counter() - started < 1
    assert _varint(memoryview(number_field(1, 2**64 - 1)), 1) == (2**64 - 1, 11)


def test_any_bytes_are_read_or_refused():
    whole = _model().SerializeToString()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(500):
        broken = bytearray(whole)
        broken[rng.integers(len(broken))] = rng.integers(256)
        try:
            OnnxFile(bytes(broken))
        except InputError:
            refused += 1
    assert 0 < refused < 500


def test_constants_in_other_files_are_refused():
    model = _model()
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "../secret.bin"
    with pytest.raises(InputError, match="constants in another file"):
        OnnxFile(model.SerializeToString())
