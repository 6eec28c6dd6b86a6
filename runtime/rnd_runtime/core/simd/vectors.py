"""Types of sixteen float32 lanes and their mask for numba, and the LLVM values that operations on them share."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import models, register_model

WIDTH = 16

FLOAT = ir.FloatType()
INT = ir.IntType(32)
FLOATS = ir.VectorType(FLOAT, WIDTH)
INTS = ir.VectorType(INT, WIDTH)
BITS = ir.VectorType(ir.IntType(1), WIDTH)


class Lanes(types.Type):
    """Type of sixteen float32 values."""


class Mask(types.Type):
    """Type of sixteen booleans."""


LANES, MASK = Lanes(name="lanes"), Mask(name="mask")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, FLOATS)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


def constant(values: list[Any], kind: Any, vector: Any) -> ir.Constant:
    return ir.Constant(vector, [ir.Constant(kind, value) for value in values])


def splat(builder: Any, value: Any) -> Any:
    single = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), value, ir.Constant(INT, 0))
    return builder.shuffle_vector(single, ir.Constant(FLOATS, ir.Undefined), constant([0] * WIDTH, INT, INTS))


def widen(builder: Any, value: Any, kind: Any) -> Any:
    """A scalar float broadcast to sixteen lanes; lanes stay."""
    if kind == LANES:
        return value
    if kind == types.float64:
        value = builder.fptrunc(value, FLOAT)
    return splat(builder, value)


def call(builder: Any, name: str, result: Any, *args: Any, flags: tuple[str, ...] = ()) -> Any:
    kind = ir.FunctionType(result, [arg.type for arg in args])
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, args, fastmath=flags)
