"""Sixteen float32 lanes as one numba value.

``Lanes`` maps to LLVM's ``<16 x float>`` and ``Mask`` to ``<16 x i1>``: one AVX-512 instruction per operation, two of
AVX2, four of SSE or NEON. Multiplications may fuse with additions (``contract``); a NaN fails every comparison.

numba's cache tracks only the file of the kernel it stored; ``.kernels`` tracks this one.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

WIDTH = 16

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FLOATS = ir.VectorType(_FLOAT, WIDTH)
_INTS = ir.VectorType(_INT, WIDTH)
_BITS = ir.VectorType(ir.IntType(1), WIDTH)


class Lanes(types.Type):
    """Type of sixteen float32 values."""


class Mask(types.Type):
    """Type of sixteen booleans."""


LANES, MASK = Lanes(name="lanes"), Mask(name="mask")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _constant(values: list[Any], kind: Any, vector: Any) -> ir.Constant:
    return ir.Constant(vector, [ir.Constant(kind, value) for value in values])


def _splat(builder: Any, value: Any) -> Any:
    single = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(single, ir.Constant(_FLOATS, ir.Undefined), _constant([0] * WIDTH, _INT, _INTS))


def _widen(builder: Any, value: Any, kind: Any) -> Any:
    """A scalar float broadcast to sixteen lanes; lanes stay."""
    if kind == LANES:
        return value
    if kind == types.float64:
        value = builder.fptrunc(value, _FLOAT)
    return _splat(builder, value)


def _operator(function: Callable[..., Any], result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Overload ``function`` for two Lanes, or Lanes and a float."""

    @type_callable(function)
    def _(context: Any) -> Callable[[Any, Any], Any]:
        def typer(a: Any, b: Any) -> Any:
            known = all(kind == LANES or isinstance(kind, types.Float) for kind in (a, b))
            return result if known and LANES in (a, b) else None

        return typer

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = (_widen(builder, value, kind) for value, kind in zip(values, signature.args))
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
    return LANES(value), lambda ctx, builder, sig, args: _widen(builder, args[0], sig.args[0])


@intrinsic
def block_x(context):  # type: ignore[no-untyped-def]
    """Column 0..3 of each lane in a block of 4×4 pixels."""
    return LANES(), lambda ctx, builder, sig, args: _constant([i % 4 for i in range(WIDTH)], _FLOAT, _FLOATS)


@intrinsic
def block_y(context):  # type: ignore[no-untyped-def]
    """Row 0..3 of each lane in a block of 4×4 pixels."""
    return LANES(), lambda ctx, builder, sig, args: _constant([i // 4 for i in range(WIDTH)], _FLOAT, _FLOATS)


@intrinsic
def select(context, mask, yes, no):  # type: ignore[no-untyped-def]
    """``yes`` where the mask holds, else ``no``."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        yes, no = (_widen(builder, value, kind) for value, kind in zip(args[1:], sig.args[1:]))
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


def _call(builder: Any, name: str, result: Any, *args: Any, flags: tuple[str, ...] = ()) -> Any:
    kind = ir.FunctionType(result, [arg.type for arg in args])
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, args, fastmath=flags)


@intrinsic
def maximum(context, a, b):  # type: ignore[no-untyped-def]
    """Lane-wise max; neither value may be NaN.

    As ``select`` and ``store`` it would compile to a masked store, up to 20 times slower.
    """
    return LANES(a, b), lambda ctx, builder, sig, args: _call(
        builder, "llvm.maxnum.v16f32", _FLOATS, *args, flags=("nnan", "nsz")
    )


@intrinsic
def magnitude(context, values):  # type: ignore[no-untyped-def]
    """|values|."""
    return LANES(values), lambda ctx, builder, sig, args: _call(builder, "llvm.fabs.v16f32", _FLOATS, args[0])


@intrinsic
def sqrt(context, values):  # type: ignore[no-untyped-def]
    """√values."""
    return LANES(values), lambda ctx, builder, sig, args: _call(builder, "llvm.sqrt.v16f32", _FLOATS, args[0])


@intrinsic
def floor(context, values):  # type: ignore[no-untyped-def]
    """⌊values⌋."""
    return LANES(values), lambda ctx, builder, sig, args: _call(builder, "llvm.floor.v16f32", _FLOATS, args[0])


@intrinsic
def reduce_add(context, values):  # type: ignore[no-untyped-def]
    """Sum over the lanes, in a fixed tree order."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, width = args[0], WIDTH
        while width > 1:
            low, high = _halves(builder, value, width)
            value, width = builder.fadd(low, high), width // 2
        return builder.extract_element(value, ir.Constant(_INT, 0))

    return types.float32(values), emit


def _halves(builder: Any, value: Any, width: int) -> tuple[Any, Any]:
    """Lower and upper half of ``width`` lanes."""
    half = width // 2
    kind = ir.VectorType(_INT, half)
    undefined = ir.Constant(value.type, ir.Undefined)
    return (
        builder.shuffle_vector(value, undefined, _constant(list(range(half)), _INT, kind)),
        builder.shuffle_vector(value, undefined, _constant(list(range(half, width)), _INT, kind)),
    )


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


@intrinsic
def load(context, array, index):  # type: ignore[no-untyped-def]
    """``array[index : index + 16]`` of a flat contiguous float32 array, unchecked."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(ctx, builder, sig.args[0], *args), align=4)

    return LANES(array, types.intp), emit


@intrinsic
def store(context, array, index, value):  # type: ignore[no-untyped-def]
    """``array[index : index + 16] = value``, unchecked."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(ctx, builder, sig.args[0], *args[:2]), align=4)
        return ctx.get_dummy_value()

    return types.void(array, types.intp, value), emit


def _prefetched(write: int) -> Callable[[Any, Any, Any], Any]:
    def prefetched(context: Any, array: Any, index: Any) -> Any:
        def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
            address = builder.bitcast(_address(ctx, builder, sig.args[0], *args), ir.IntType(8).as_pointer())
            locality, data = ir.Constant(_INT, 3), ir.Constant(_INT, 1)
            _call(builder, "llvm.prefetch.p0i8", ir.VoidType(), address, ir.Constant(_INT, write), locality, data)
            return ctx.get_dummy_value()

        return types.void(array, types.intp), emit

    return prefetched


# Of the cache line of array[index]; an index past the end is harmless.
prefetch, prefetch_to_write = intrinsic(_prefetched(0)), intrinsic(_prefetched(1))


@intrinsic
def broadcast(context, array, index):  # type: ignore[no-untyped-def]
    """``array[index]`` of a flat contiguous float32 array in all lanes, unchecked."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = ctx.make_array(sig.args[0])(ctx, builder, args[0]).data
        return _splat(builder, builder.load(builder.gep(data, [args[1]])))

    return LANES(array, types.intp), emit


@intrinsic
def load_points(context, array, index):  # type: ignore[no-untyped-def]
    """x, y, z of sixteen rows [3] from flat ``array[index]`` on (contiguous float32), unchecked."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        ahead = [builder.add(args[1], ir.Constant(args[1].type, WIDTH * k)) for k in range(3)]
        a, b, c = (builder.load(_address(ctx, builder, sig.args[0], args[0], at), align=4) for at in ahead)
        values = []
        for axis in range(3):
            positions = range(axis, 3 * WIDTH, 3)
            of_two = [at if at < 2 * WIDTH else 0 for at in positions]
            of_all = [k if at < 2 * WIDTH else at - WIDTH for k, at in enumerate(positions)]
            two = builder.shuffle_vector(a, b, _constant(of_two, _INT, _INTS))
            values.append(builder.shuffle_vector(two, c, _constant(of_all, _INT, _INTS)))
        return ctx.make_tuple(builder, sig.return_type, values)

    return types.UniTuple(LANES, 3)(array, types.intp), emit


@intrinsic
def store_mask(context, array, index, mask):  # type: ignore[no-untyped-def]
    """``array[index : index + 16] = mask`` of a flat contiguous boolean array, unchecked."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        bytes_ = ir.VectorType(ir.IntType(8), WIDTH)
        address = builder.gep(ctx.make_array(sig.args[0])(ctx, builder, args[0]).data, [args[1]])
        builder.store(builder.zext(args[2], bytes_), builder.bitcast(address, bytes_.as_pointer()), align=1)
        return ctx.get_dummy_value()

    return types.void(array, types.intp, mask), emit


@intrinsic
def transpose(context, source, target):  # type: ignore[no-untyped-def]
    """Transpose ``source`` [16 · 16] into ``target``; both flat, contiguous float32."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        starts = [ir.Constant(ir.IntType(64), WIDTH * k) for k in range(WIDTH)]
        rows = [builder.load(_address(ctx, builder, sig.args[0], args[0], at), align=4) for at in starts]
        for step in (1, 2, 4, 8):  # swap the off-diagonal blocks of this size
            upper = [k for k in range(WIDTH) if not k & step]
            low = [j if not j & step else WIDTH + j - step for j in range(WIDTH)]
            high = [j + step if not j & step else WIDTH + j for j in range(WIDTH)]
            for k in upper:
                a, b = rows[k], rows[k + step]
                rows[k] = builder.shuffle_vector(a, b, _constant(low, _INT, _INTS))
                rows[k + step] = builder.shuffle_vector(a, b, _constant(high, _INT, _INTS))
        for at, row in zip(starts, rows):
            builder.store(row, _address(ctx, builder, sig.args[1], args[1], at), align=4)
        return ctx.get_dummy_value()

    return types.void(source, target), emit


def _exp2_coefficients() -> list[float]:
    """Degree 5 coefficients of 2^x on [−½, ½], interpolated at Chebyshev nodes (relative error 1e-7)."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    return [float(c) for c in np.linalg.solve(np.vander(nodes, increasing=True), np.exp2(nodes))]


_EXP2 = _exp2_coefficients()


@intrinsic
def exp2(context, power):  # type: ignore[no-untyped-def]
    """2^power for powers in [−126, 127]; NaN for NaN; undefined elsewhere."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        rounded = _call(builder, "llvm.rint.v16f32", _FLOATS, args[0])
        rest = builder.fsub(args[0], rounded)
        value = _splat(builder, ir.Constant(_FLOAT, np.float32(_EXP2[-1]).item()))
        for coefficient in reversed(_EXP2[:-1]):
            term = _splat(builder, ir.Constant(_FLOAT, np.float32(coefficient).item()))
            value = builder.fadd(builder.fmul(value, rest, flags=("contract",)), term, flags=("contract",))
        shift = _constant([23] * WIDTH, _INT, _INTS)
        exponent = builder.shl(builder.fptosi(rounded, _INTS), shift)
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return LANES(power), emit


@intrinsic
def fetch_add(context, counter):  # type: ignore[no-untyped-def]
    """Atomically increment ``counter[0]`` (int64); return its old value."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = ctx.make_array(sig.args[0])(ctx, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit


@njit(inline="always")
def at_least(x, low):  # type: ignore[no-untyped-def]
    """Lane-wise max of ``x`` and ``low``; ``low`` where x is NaN."""
    return select(x > low, x, low)


@njit(inline="always")
def aligned_floats(count: int) -> np.ndarray[Any, Any]:
    """Uninitialised flat float32 array [count], aligned to cache lines."""
    scratch = np.empty(count + WIDTH, np.float32)
    skip = (-(scratch.ctypes.data // 4)) % WIDTH
    return scratch[skip : skip + count]
