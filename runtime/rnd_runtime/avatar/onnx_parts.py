"""Cutting subgraphs out of an ONNX file, without the onnx package.

onnxruntime computes every node of a graph whatever outputs are asked for, so that half of an avatar costs as much as
the whole. ``OnnxFile`` reads just enough of the file's protocol buffer (https://protobuf.dev/programming-guides/
encoding and onnx.proto of IR version 8) to leave out nodes, constants and outputs that are not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from rnd_runtime.core.errors import InputError

# Field numbers of onnx.proto
_MODEL_GRAPH, _MODEL_OPSET, _MODEL_METADATA, _MODEL_TRAINING, _MODEL_FUNCTIONS = 7, 8, 14, 20, 25
_GRAPH_NODE, _GRAPH_INITIALIZER, _GRAPH_INPUT, _GRAPH_OUTPUT, _GRAPH_VALUE_INFO = 1, 5, 11, 12, 13
_GRAPH_SPARSE = 15
_NODE_INPUT, _NODE_OUTPUT, _NODE_OPERATOR, _NODE_ATTRIBUTE, _NODE_DOMAIN = 1, 2, 4, 5, 7
_ATTRIBUTE_NAME, _ATTRIBUTE_INT, _ATTRIBUTE_TENSOR, _ATTRIBUTE_INTS = 1, 3, 5, 8
_ATTRIBUTE_PLAIN = {1, 2, 3, 4, 5, 7, 8, 9, 13, 20}  # numbers, texts, a tensor; no graphs, references or sparse tensors
_TENSOR_DIMS, _TENSOR_TYPE, _TENSOR_INT64, _TENSOR_NAME, _TENSOR_RAW = 1, 2, 7, 8, 9
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14
_FLOAT, _INT64 = 1, 7  # TensorProto.DataType
_DEFAULT_DOMAINS = ("", "ai.onnx")

_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5  # wire types
_LONGEST_VARINT = 10  # bytes: 64 bits, seven in each
_SHORT = 1024  # bytes of a constant that may be a shape


class Node(NamedTuple):
    """An operation: names of its inputs and outputs, its bytes, its name and its integer attributes."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    data: memoryview
    operator: str
    attributes: dict[str, tuple[int, ...]]


class Constant(NamedTuple):
    """A tensor of the file: its field's bytes, its shape, and its numbers where they are int64."""

    data: memoryview
    shape: tuple[int, ...]
    integers: tuple[int, ...] | None


class Rows(NamedTuple):
    """Of ``total`` things that a graph treats alike, the ``kept`` ones, ascending.

    Constants of so many rows are theirs, and that number among the sizes of a shape is theirs too.
    """

    total: int
    kept: Sequence[int]


class OnnxFile:
    """The parts of an ONNX model.

    Attributes:
        inputs, outputs: shape of every float32 input and output of the graph by name.
        metadata: the model's ``metadata_props``.

    Raises:
        InputError: not a protocol buffer, cut short, without a graph, with graphs within operators, functions,
            operators of other domains, or data in other files.
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
        self._constants: dict[str, Constant] = {}
        self._input_data: dict[str, memoryview] = {}
        self.inputs: dict[str, list[int]] = {}
        self.outputs: dict[str, list[int]] = {}
        self.metadata: dict[str, str] = {}
        for number, value, record in _fields(data):
            if number == _MODEL_GRAPH:
                self._read_graph(value)
                continue
            self._head += record
            if number in (_MODEL_TRAINING, _MODEL_FUNCTIONS):
                raise InputError("ONNX model", expected="one graph", got="functions or training graphs")
            if number == _MODEL_OPSET:
                _check_domain({n: v for n, v, _ in _fields(value)}.get(1, value[:0]))
            if number == _MODEL_METADATA:
                entry = {n: _text(v) for n, v, _ in _fields(value)}
                self.metadata[entry.get(1, "")] = entry.get(2, "")

    def _read_graph(self, graph: memoryview) -> None:
        for number, value, record in _fields(graph):
            if number == _GRAPH_NODE:
                self._nodes.append(_node(value, record))
            elif number == _GRAPH_INITIALIZER:
                name, constant = _tensor(value, record)
                self._constants[name] = constant
            elif number == _GRAPH_SPARSE:
                raise InputError("ONNX model", expected="dense constants", got="sparse ones")
            elif number == _GRAPH_INPUT:
                name, shape = _value_info(value)
                self.inputs[name], self._input_data[name] = shape, record
            elif number == _GRAPH_OUTPUT:
                name, shape = _value_info(value)
                self.outputs[name] = shape
            elif number != _GRAPH_VALUE_INFO:  # shapes that onnxruntime infers anyway
                self._graph_head += record

    @property
    def nodes(self) -> list[Node]:
        """All operations, in an order in which they can be computed."""
        return self._nodes

    @property
    def constants(self) -> dict[str, Constant]:
        """The graph's tensors by name."""
        return self._constants

    def _missing(self, names: Iterable[str]) -> list[str]:
        """Those of ``names`` that are no value of the graph."""
        produced = {name for node in self._nodes for name in node.outputs}
        return [n for n in names if not (n in produced or n in self._constants or n in self._input_data)]

    def extract(self, outputs: Sequence[str], rows: Rows | None = None) -> bytes:
        """A model that makes values ``outputs`` (any of the graph's, inner ones too) and nothing else.

        Its inputs are those of the full graph that it needs; metadata are kept. With ``rows`` it is evaluated for some
        of so many alike, see ``Rows``.

        Raises:
            InputError: nothing in the graph makes one of them.
        """
        if missing := self._missing(outputs):
            raise InputError("graph outputs", expected=f"something that makes {', '.join(missing)}", got="nothing")
        wanted = set(outputs)
        kept: list[Node] = []
        for node in reversed(self._nodes):  # ONNX demands topological order
            if wanted.intersection(node.outputs):
                kept.append(node)
                wanted.update(node.inputs)
        graph = bytearray(self._graph_head)
        for node in reversed(kept):
            graph += node.data
        for name, constant in self._constants.items():
            if name in wanted:
                graph += constant.data if rows is None else _with_rows(constant, rows)
        for name, data in self._input_data.items():
            if name in wanted:
                graph += data
        for name in outputs:
            graph += bytes_field(_GRAPH_OUTPUT, bytes_field(1, name.encode()))
        return bytes(self._head + bytes_field(_MODEL_GRAPH, graph))


def _with_rows(constant: Constant, rows: Rows) -> bytes | memoryview:
    """The field of ``constant`` for some rows alone."""
    by_row = constant.shape[:1] == (rows.total,)
    sizes = () if by_row else constant.integers or ()
    if not by_row and rows.total not in sizes:
        return constant.data
    ((_, tensor, _),) = _fields(constant.data)
    fields = {number: value for number, value, _ in _fields(tensor) if number in (_TENSOR_RAW, _TENSOR_INT64)}
    if by_row and _TENSOR_RAW not in fields:
        raise InputError("constants of an ONNX model", expected="raw data", got="lists of numbers")
    values = fields.get(_TENSOR_RAW, tensor[:0])
    if by_row:
        size = len(values) // rows.total
        raw = b"".join(values[row * size : (row + 1) * size] for row in rows.kept)
    else:
        raw = struct.pack(f"<{len(sizes)}q", *(len(rows.kept) if size == rows.total else size for size in sizes))
    changed = {_TENSOR_DIMS, *fields}
    content = b"".join(record for number, _, record in _fields(tensor) if number not in changed)
    for size in (len(rows.kept), *constant.shape[1:]) if by_row else constant.shape:
        content += number_field(_TENSOR_DIMS, size)
    return bytes_field(_GRAPH_INITIALIZER, content + bytes_field(_TENSOR_RAW, raw))


def _node(data: memoryview, record: memoryview) -> Node:
    names: dict[int, list[str]] = {_NODE_INPUT: [], _NODE_OUTPUT: []}
    operator, attributes = "", {}
    for number, value, _ in _fields(data):
        if number in names:
            names[number].append(_text(value))
        elif number == _NODE_OPERATOR:
            operator = _text(value)
        elif number == _NODE_DOMAIN:
            _check_domain(value)
        elif number == _NODE_ATTRIBUTE:
            name, numbers = _attribute(value)
            if name in attributes:
                raise InputError("ONNX model", expected=f"one attribute {name}", got="several")
            attributes[name] = numbers
    return Node(tuple(names[_NODE_INPUT]), tuple(names[_NODE_OUTPUT]), record, operator, attributes)


def _check_domain(domain: memoryview) -> None:
    if (name := _text(domain)) not in _DEFAULT_DOMAINS:
        raise InputError("ONNX model", expected="standard operators", got=f"some of {name}")


def _attribute(data: memoryview) -> tuple[str, tuple[int, ...]]:
    """Name and integers of an AttributeProto."""
    name, numbers = "", []
    for number, value, record in _fields(data):
        if number not in _ATTRIBUTE_PLAIN:
            raise InputError("ONNX model", expected="numbers as attributes", got="graphs or tensors in operators")
        if number == _ATTRIBUTE_NAME:
            name = _text(value)
        elif number == _ATTRIBUTE_TENSOR:
            _tensor(value, record)
        elif number in (_ATTRIBUTE_INT, _ATTRIBUTE_INTS):
            numbers += _signed(value)
    return name, tuple(numbers)


def _tensor(data: memoryview, record: memoryview) -> tuple[str, Constant]:
    name, kind, raw = "", 0, data[:0]
    dims: list[int] = []
    integers: list[int] = []
    for number, value, _ in _fields(data):
        if number in (_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION):
            raise InputError("not a whole ONNX model", got="constants in another file")
        if number == _TENSOR_NAME:
            name = _text(value)
        elif number == _TENSOR_DIMS:
            dims += _signed(value)
        elif number == _TENSOR_TYPE:
            kind = _varint(value, 0)[0]
        elif number == _TENSOR_RAW:
            raw = value
        elif number == _TENSOR_INT64:
            integers += _signed(value)
    if min(dims, default=0) < 0:
        raise InputError("ONNX model", expected="sizes of a constant", got=min(dims))
    if kind == _INT64 and raw:
        integers = list(struct.unpack(f"<{len(raw) // 8}q", raw[: len(raw) // 8 * 8])) if len(raw) <= _SHORT else []
    return name, Constant(record, tuple(dims), tuple(integers) if kind == _INT64 else None)


def _signed(data: memoryview) -> list[int]:
    """The int64 numbers that are packed in ``data``."""
    numbers, at = [], 0
    while at < len(data):
        number, at = _varint(data, at)
        numbers.append(number - (1 << 64) if number >> 63 else number)
    return numbers


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
