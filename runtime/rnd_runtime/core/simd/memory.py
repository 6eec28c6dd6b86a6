"""Lanes from and to flat, contiguous arrays, without checks of bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

from .vectors import FLOATS, INT, INTS, LANES, WIDTH, call, constant, splat


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), FLOATS.as_pointer())


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
            locality, data = ir.Constant(INT, 3), ir.Constant(INT, 1)
            call(builder, "llvm.prefetch.p0i8", ir.VoidType(), address, ir.Constant(INT, write), locality, data)
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
        return splat(builder, builder.load(builder.gep(data, [args[1]])))

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
            two = builder.shuffle_vector(a, b, constant(of_two, INT, INTS))
            values.append(builder.shuffle_vector(two, c, constant(of_all, INT, INTS)))
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
                rows[k] = builder.shuffle_vector(a, b, constant(low, INT, INTS))
                rows[k + step] = builder.shuffle_vector(a, b, constant(high, INT, INTS))
        for at, row in zip(starts, rows):
            builder.store(row, _address(ctx, builder, sig.args[1], args[1], at), align=4)
        return ctx.get_dummy_value()

    return types.void(source, target), emit


@intrinsic
def fetch_add(context, counter):  # type: ignore[no-untyped-def]
    """Atomically increment ``counter[0]`` (int64); return its old value."""

    def emit(ctx: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = ctx.make_array(sig.args[0])(ctx, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit


@njit(inline="always")
def aligned_floats(count: int) -> np.ndarray[Any, Any]:
    """Uninitialised flat float32 array [count], aligned to cache lines."""
    scratch = np.empty(count + WIDTH, np.float32)
    skip = (-(scratch.ctypes.data // 4)) % WIDTH
    return scratch[skip : skip + count]
