"""Arithmetic, comparison and reduction of lanes.

Multiplications may fuse with additions (``contract``); a NaN fails every comparison.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic, lower_builtin, type_callable

from .vectors import FLOAT, FLOATS, INT, INTS, LANES, MASK, WIDTH, Lanes, Mask, call, constant, splat, widen


def _operator(function: Callable[..., Any], result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Overload ``function`` for two Lanes, or Lanes and a float."""

    @type_callable(function)
    def _(context: Any) -> Callable[[Any, Any], Any]:
        def typer(a: Any, b: Any) -> Any:
            known = all(kind == LANES or isinstance(kind, types.Float) for kind in (a, b))
            return result if known and LANES in (a, b) else None

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = (widen(builder, value, kind) for value, kind in zip(values, signature.args))
        return emit(builder, a, b)

    for kinds in ((Lanes, Lanes), (Lanes, types.Float), (types.Float, Lanes)):
        lower_builtin(function, *kinds)(lower)


for _add in (operator.add, operator.iadd):
    _operator(_add, LANES, lambda b, x, y: b.fadd(x, y, flags=("contract",)))
for _subtract in (operator.sub, operator.isub):
    _operator(_subtract, LANES, lambda b, x, y: b.fsub(x, y, flags=("contract",)))
_operator(operator.mul, LANES, lambda b, x, y: b.fmul(x, y, flags=("contract",)))
_operator(operator.truediv, LANES, lambda b, x, y: b.fdiv(x, y))
_operator(operator.ge, MASK, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_operator(operator.gt, MASK, lambda b, x, y: b.fcmp_ordered(">", x, y))
_operator(operator.lt, MASK, lambda b, x, y: b.fcmp_ordered("<", x, y))


@type_callable(operator.and_)
def _type_and(context: Any) -> Callable[[Any, Any], Any]:
    return lambda a, b: MASK if a == MASK and b == MASK else None


@lower_builtin(operator.and_, Mask, Mask)
def _lower_and(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.and_(*values)


@intrinsic
def lanes(context, value):  # type: ignore[no-untyped-def]
    """``value`` in all sixteen lanes."""
    return LANES(value), lambda ctx, builder, sig, args: widen(builder, args[0], sig.args[0])


@intrinsic
def block_x(context):  # type: ignore[no-untyped-def]
    """Column 0..3 of each lane in a block of 4×4 pixels."""
    return LANES(), lambda ctx, builder, sig, args: constant([i % 4 for i in range(WIDTH)], FLOAT, FLOATS)


@intrinsic
def block_y(context):  # type: ignore[no-untyped-def]
    """Row 0..3 of each lane in a block of 4×4 pixels."""
    return LANES(), lambda ctx, builder, sig, args: constant([i // 4 for i in range(WIDTH)], FLOAT, FLOATS)


@intrinsic
def select(context, mask, yes, no):  # type: ignore[no-untyped-def]
    """``yes`` where the mask holds, else ``no``."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        yes, no = (widen(builder, value, kind) for value, kind in zip(args[1:], sig.args[1:]))
        return builder.select(args[0], yes, no)

    return LANES(mask, yes, no), emit


@intrinsic
def any_lane(context, mask):  # type: ignore[no-untyped-def]
    """Whether the mask holds in any lane."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(mask), emit


@intrinsic
def bits(context, mask):  # type: ignore[no-untyped-def]
    """The mask as an integer, lane i in bit i."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(WIDTH)), ir.IntType(64))

    return types.int64(mask), emit


@intrinsic
def lowest_bit(context, value):  # type: ignore[no-untyped-def]
    """Index of the lowest set bit of a non-zero int64."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


@intrinsic
def maximum(context, a, b):  # type: ignore[no-untyped-def]
    """Lane-wise max; neither value may be NaN.

    As ``select`` and ``store`` it would compile to a masked store, up to 20 times slower.
    """
    return LANES(a, b), lambda ctx, builder, sig, args: call(
        builder, "llvm.maxnum.v16f32", FLOATS, *args, flags=("nnan", "nsz")
    )


@intrinsic
def magnitude(context, values):  # type: ignore[no-untyped-def]
    """|values|."""
    return LANES(values), lambda ctx, builder, sig, args: call(builder, "llvm.fabs.v16f32", FLOATS, args[0])


@intrinsic
def sqrt(context, values):  # type: ignore[no-untyped-def]
    """√values."""
    return LANES(values), lambda ctx, builder, sig, args: call(builder, "llvm.sqrt.v16f32", FLOATS, args[0])


@intrinsic
def floor(context, values):  # type: ignore[no-untyped-def]
    """⌊values⌋."""
    return LANES(values), lambda ctx, builder, sig, args: call(builder, "llvm.floor.v16f32", FLOATS, args[0])


@intrinsic
def reduce_add(context, values):  # type: ignore[no-untyped-def]
    """Sum over the lanes, in a fixed tree order."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, width = args[0], WIDTH
        while width > 1:
            low, high = _halves(builder, value, width)
            value, width = builder.fadd(low, high), width // 2
        return builder.extract_element(value, ir.Constant(INT, 0))

    return types.float32(values), emit


def _halves(builder: Any, value: Any, width: int) -> tuple[Any, Any]:
    """Lower and upper half of ``width`` lanes."""
    half = width // 2
    kind = ir.VectorType(INT, half)
    undefined = ir.Constant(value.type, ir.Undefined)
    return (
        builder.shuffle_vector(value, undefined, constant(list(range(half)), INT, kind)),
        builder.shuffle_vector(value, undefined, constant(list(range(half, width)), INT, kind)),
    )


def _exp2_coefficients() -> list[float]:
    """Degree 5 coefficients of 2^x on [−½, ½], interpolated at Chebyshev nodes (relative error 1e-7)."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    return [float(c) for c in np.linalg.solve(np.vander(nodes, increasing=True), np.exp2(nodes))]


_EXP2 = _exp2_coefficients()


@intrinsic
def exp2(context, power):  # type: ignore[no-untyped-def]
    """2^power for powers in [−126, 127]; NaN for NaN; undefined elsewhere."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        rounded = call(builder, "llvm.rint.v16f32", FLOATS, args[0])
        rest = builder.fsub(args[0], rounded)
        value = splat(builder, ir.Constant(FLOAT, np.float32(_EXP2[-1]).item()))
        for coefficient in reversed(_EXP2[:-1]):
            term = splat(builder, ir.Constant(FLOAT, np.float32(coefficient).item()))
            value = builder.fadd(builder.fmul(value, rest, flags=("contract",)), term, flags=("contract",))
        shift = constant([23] * WIDTH, INT, INTS)
        exponent = builder.shl(builder.fptosi(rounded, INTS), shift)
        return builder.bitcast(builder.add(builder.bitcast(value, INTS), exponent), FLOATS)

    return LANES(power), emit


@njit(inline="always")
def at_least(x, low):  # type: ignore[no-untyped-def]
    """Lane-wise max of ``x`` and ``low``; ``low`` where x is NaN."""
    return select(x > low, x, low)
