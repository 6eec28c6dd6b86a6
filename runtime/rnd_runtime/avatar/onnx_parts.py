"""Cutting subgraphs out of an ONNX file, without the onnx package.

onnxruntime computes every node of a graph whatever outputs are asked for, so that half of an avatar costs as much as
the whole. ``OnnxFile`` reads just enough of the file's protocol buffer (https://protobuf.dev/programming-guides/
encoding and onnx.proto of IR version 8) to leave out nodes, constants and outputs that are not needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from rnd_runtime.core.errors import InputError

# Field numbers of onnx.proto
_MODEL_GRAPH, _MODEL_METADATA = 7, 14
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_INPUT, _GRAPH_OUTPUT, _GRAPH_VALUE_INFO = 1, 5, 11, 12, 13
_NODE_INPUT, _NODE_OUTPUT = 1, 2
_TENSOR_NAME, _TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 8, 13, 14
_FLOAT = 1  # TensorProto.DataType

_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5  # wire types
_LONGEST_VARINT = 10  # bytes: 64 bits, seven in each


class Node(NamedTuple):
    """An operation: names of what it reads and makes, and its bytes."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    data: memoryview


class OnnxFile:
    """The parts of an ONNX model.

    Attributes:
        inputs, outputs: shape of every float32 input and output of the graph by name.
        metadata: the model's ``metadata_props``.

    Raises:
        InputError: not a protocol buffer, cut short, without a graph, or with data in other files.
    """

    def __init__(self, data: bytes) -> None:
        try:
            self._read(memoryview(data))
        except (IndexError, KeyError, UnicodeDecodeError) as error:
            raise InputError("not a readable ONNX model") from error
        if not self._nodes or not self.outputs:
            raise InputError("not a readable ONNX model", got="no graph")

    def _read(self, data: memoryview) -> None:
        self._head = bytearray()  # the model without its graph
        self._graph_head = bytearray()  # the graph without nodes, constants, inputs and outputs
        self._nodes: list[Node] = []
        self._constants: dict[str, memoryview] = {}
        self._input_data: dict[str, memoryview] = {}
        self.inputs: dict[str, list[int]] = {}
        self.outputs: dict[str, list[int]] = {}
        self.metadata: dict[str, str] = {}
        for number, value, whole in _fields(data):
            if number == _MODEL_GRAPH:
                self._read_graph(value)
                continue
            self._head += whole
            if number == _MODEL_METADATA:
                entry = {n: _text(v) for n, v, _ in _fields(value)}
                self.metadata[entry.get(1, "")] = entry.get(2, "")

    def _read_graph(self, graph: memoryview) -> None:
        for number, value, whole in _fields(graph):
            if number == _GRAPH_NODE:
                names: dict[int, list[str]] = {_NODE_INPUT: [], _NODE_OUTPUT: []}
                for part, text, _ in _fields(value):
                    if part in names:
                        names[part].append(_text(text))
                self._nodes.append(Node(tuple(names[_NODE_INPUT]), tuple(names[_NODE_OUTPUT]), whole))
            elif number == _GRAPH_INITIALIZER:
                parts = {part: text for part, text, _ in _fields(value)}
                if _TENSOR_EXTERNAL_DATA in parts or _TENSOR_DATA_LOCATION in parts:
                    raise InputError("not a whole ONNX model", got="constants in another file")
                self._constants[_text(parts[_TENSOR_NAME])] = whole
            elif number == _GRAPH_INPUT:
                name, shape = _value_info(value)
                self.inputs[name], self._input_data[name] = shape, whole
            elif number == _GRAPH_OUTPUT:
                name, shape = _value_info(value)
                self.outputs[name] = shape
            elif number != _GRAPH_VALUE_INFO:  # shapes that onnxruntime infers anyway
                self._graph_head += whole

    def _lost(self, names: Iterable[str]) -> list[str]:
        """Those of ``names`` that are no value of the graph."""
        made = {name for node in self._nodes for name in node.outputs}
        return [n for n in names if not (n in made or n in self._constants or n in self._input_data)]

    def cut(self, outputs: Sequence[str]) -> bytes:
        """A model that makes values ``outputs`` (any of the graph's, inner ones too) and nothing else.

        Its inputs are those of the whole that are needed for that; metadata are kept.

        Raises:
            InputError: nothing in the graph makes one of them.
        """
        if lost := self._lost(outputs):
            raise InputError("graph outputs", expected=f"something that makes {', '.join(lost)}", got="nothing")
        wanted = set(outputs)
        kept: list[Node] = []
        for node in reversed(self._nodes):  # ONNX demands topological order
            if wanted.intersection(node.outputs):
                kept.append(node)
                wanted.update(node.inputs)
        graph = bytearray(self._graph_head)
        for node in reversed(kept):
            graph += node.data
        for values in (self._constants, self._input_data):
            for name, data in values.items():
                if name in wanted:
                    graph += data
        for name in outputs:
            graph += bytes_field(_GRAPH_OUTPUT, bytes_field(1, name.encode()))
        return bytes(self._head + bytes_field(_MODEL_GRAPH, graph))


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview, memoryview]]:
    """Number, value and all bytes of every field; IndexError where they do not fit."""
    at = 0
    while at < len(data):
        start = at
        key, at = _varint(data, at)
        kind = key & 7
        if kind == _VARINT:
            value = at
            _, at = _varint(data, at)
        elif kind == _LENGTH:
            size, value = _varint(data, at)
            at = value + size
        elif kind in (_EIGHT_BYTES, _FOUR_BYTES):
            value, at = at, at + (8 if kind == _EIGHT_BYTES else 4)
        else:
            raise IndexError(kind)
        if at > len(data):
            raise IndexError(at)
        yield key >> 3, data[value:at], data[start:at]


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """The number at ``at`` and where it ends; IndexError where it is longer than any."""
    number = 0
    for k in range(_LONGEST_VARINT):
        byte = data[at + k]
        number |= (byte & 127) << 7 * k
        if byte < 128:
            return number, at + k + 1
    raise IndexError(at)


def bytes_field(number: int, value: bytes | bytearray) -> bytes:
    """A field of bytes: a text, a message, raw data."""
    return _coded(number << 3 | _LENGTH) + _coded(len(value)) + value


def number_field(number: int, value: int) -> bytes:
    """A field that holds the number ``value``, not negative."""
    return _coded(number << 3 | _VARINT) + _coded(value)


def _coded(number: int) -> bytes:
    coded = bytearray()
    while number > 127:
        coded.append(number & 127 | 128)
        number >>= 7
    coded.append(number)
    return bytes(coded)


def _text(value: memoryview) -> str:
    return bytes(value).decode()


def _value_info(data: memoryview) -> tuple[str, list[int]]:
    """Name and shape of a ValueInfoProto; the shape is empty unless it is a float32 tensor of a fixed shape."""
    name, shape = "", []
    for number, value, _ in _fields(data):
        if number == 1:
            name = _text(value)
        elif number == 2:
            tensor = {n: v for n, v, _ in _fields(value)}.get(1, value[:0])
            parts = {n: v for n, v, _ in _fields(tensor)}
            if 1 in parts and _varint(parts[1], 0)[0] == _FLOAT and 2 in parts:
                for _, dimension, _ in _fields(parts[2]):
                    sizes = [_varint(v, 0)[0] for n, v, _ in _fields(dimension) if n == 1]
                    shape.append(sizes[0] if sizes else -1)
    return name, shape
