"""The operators of an avatar.onnx, and how large the values of its graph are, before anything is computed.

onnxruntime computes what depends on no input while it loads a file, so a small file could fill the memory with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.errors import InputError

from .onnx_parts import Node, OnnxFile

Shape = tuple[int, ...]
_VALUE_BYTES = 4  # of a number
_FRAME_TIMES = 16  # what all values of a frame may take, in budgets: most are freed before the last is made


class _Shapes:
    """Shapes of the values of a graph, by name."""

    def __init__(self, file: OnnxFile) -> None:
        self._integers = {name: constant.integers for name, constant in file.constants.items()}
        self.known: dict[str, Shape] = {name: tuple(shape) for name, shape in file.inputs.items()}
        self.known.update((name, constant.shape) for name, constant in file.constants.items())

    def __call__(self, node: Node, index: int = 0) -> Shape:
        """The shape of the node's input ``index``."""
        return self.known[node.inputs[index]]

    def numbers(self, node: Node, index: int) -> tuple[int, ...]:
        """The int64 numbers of the node's input ``index``, a constant of the file."""
        numbers = self._integers[node.inputs[index]]
        if numbers is None:
            raise ValueError("a shape that is not int64")
        return numbers


def _same(node: Node, shapes: _Shapes) -> list[Shape]:
    return [shapes(node)]


def _broadcast(*shapes: Shape) -> Shape:
    rank = max(map(len, shapes))
    padded = [(1,) * (rank - len(shape)) + shape for shape in shapes]
    return tuple(0 if 0 in sizes else max(sizes) for sizes in zip(*padded))


def _elementwise(node: Node, shapes: _Shapes) -> list[Shape]:
    return [_broadcast(*(shapes(node, k) for k in range(len(node.inputs))))]


def _matmul(node: Node, shapes: _Shapes) -> list[Shape]:
    a, b = shapes(node, 0), shapes(node, 1)
    rows, columns = a[-2:-1], b[-1:] if len(b) > 1 else ()
    return [(*_broadcast(a[:-2], b[:-2]), *rows, *columns)]


def _gemm(node: Node, shapes: _Shapes) -> list[Shape]:
    a, b = shapes(node, 0), shapes(node, 1)
    across_a, across_b = node.attributes.get("transA", (0,))[0], node.attributes.get("transB", (0,))[0]
    return [(a[1 if across_a else 0], b[0 if across_b else 1])]


def _axis(node: Node, default: int = 0) -> int:
    return node.attributes.get("axis", (default,))[0]


def _concat(node: Node, shapes: _Shapes) -> list[Shape]:
    parts = [list(shapes(node, k)) for k in range(len(node.inputs))]
    axis, shape = _axis(node), parts[0]
    shape[axis] = sum(part[axis] for part in parts)
    return [tuple(shape)]


def _gather(node: Node, shapes: _Shapes) -> list[Shape]:
    data, axis = shapes(node, 0), _axis(node) % len(shapes(node, 0))
    return [(*data[:axis], *shapes(node, 1), *data[axis + 1 :])]


def _reshape(node: Node, shapes: _Shapes) -> list[Shape]:
    old, new = shapes(node), list(shapes.numbers(node, 1))
    new = [old[k] if size == 0 else size for k, size in enumerate(new)]
    if -1 in new:
        at = new.index(-1)
        new[at] = math.prod(old) // max(math.prod(new[:at] + new[at + 1 :]), 1)
    if math.prod(new) != math.prod(old):
        raise ValueError("another number of elements")
    return [tuple(new)]


def _split(node: Node, shapes: _Shapes) -> list[Shape]:
    shape, axis, outputs = shapes(node), _axis(node), []
    for size in shapes.numbers(node, 1):
        part = list(shape)
        part[axis] = size
        outputs.append(tuple(part))
    return outputs


def _transpose(node: Node, shapes: _Shapes) -> list[Shape]:
    shape = shapes(node)
    return [tuple(shape[k] for k in node.attributes.get("perm", tuple(range(len(shape)))[::-1]))]


def _reduce(node: Node, shapes: _Shapes) -> list[Shape]:
    shape = shapes(node)
    axes = shapes.numbers(node, 1) if len(node.inputs) > 1 else tuple(range(len(shape)))
    reduced, kept = {axis % len(shape) for axis in axes}, node.attributes.get("keepdims", (1,))[0]
    sizes = [1 if k in reduced else size for k, size in enumerate(shape)]
    return [tuple(size for k, size in enumerate(sizes) if kept or k not in reduced)]


def _filled(node: Node, shapes: _Shapes) -> list[Shape]:
    return [shapes.numbers(node, 0)]


_SHAPES: dict[str, Callable[[Node, _Shapes], list[Shape]]] = {
    **dict.fromkeys(("Cast", "Cos", "CumSum", "Identity", "LayerNormalization", "Relu", "ScatterElements"), _same),
    **dict.fromkeys(("Sin", "Softmax", "Tanh"), _same),
    **dict.fromkeys(("Add", "Div", "Max", "Min", "Mul", "Sub"), _elementwise),
    **dict.fromkeys(("ReduceL2", "ReduceSum", "ReduceSumSquare"), _reduce),
    "Concat": _concat,
    "ConstantOfShape": _filled,
    "Gather": _gather,
    "Gemm": _gemm,
    "MatMul": _matmul,
    "Reshape": _reshape,
    "Split": _split,
    "Transpose": _transpose,
}
OPERATORS = frozenset(_SHAPES)
"""what the exporter writes; a file with any other is refused"""


def check_operators(file: OnnxFile, file_bytes: int) -> None:
    """Raise ``InputError`` unless ``file`` is made of ``OPERATORS`` and its values fit the budget of ``file_bytes``.

    Values that depend on no input are counted together, as onnxruntime keeps them; each other one fits alone, and all
    of a frame in several budgets.
    """
    if strange := sorted({node.operator for node in file.nodes} - OPERATORS):
        raise InputError("operators", expected="those of rnd-export", got=", ".join(strange))
    shapes, varying = _Shapes(file), set(file.inputs)
    constants, budget = Budget(file_bytes), Budget(file_bytes)
    frame = budget.limit * _FRAME_TIMES
    for node in file.nodes:
        try:
            outputs = _SHAPES[node.operator](node, shapes)
            if any(size < 0 for shape in outputs for size in shape):
                raise ValueError("negative size")
        except (KeyError, IndexError, ValueError, ZeroDivisionError) as error:
            raise InputError(f"operator {node.operator}", expected="inputs of known shapes", got=error) from error
        size = sum(map(math.prod, outputs)) * _VALUE_BYTES
        depends = not varying.isdisjoint(node.inputs)
        (Budget(file_bytes) if depends else constants).take(size, f"value {node.outputs[0] if node.outputs else ''}")
        frame -= size if depends else 0
        if frame < 0:
            raise InputError(
                "values of a frame", expected=f"at most {budget.limit * _FRAME_TIMES >> 20} MB", got="more"
            )
        varying.update(node.outputs if depends else ())
        shapes.known.update(zip(node.outputs, outputs))
