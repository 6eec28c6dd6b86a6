"""Checks and conversions of kernel inputs, and copies of what changes from frame to frame."""

from __future__ import annotations

import sys
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

T = TypeVar("T")
Floats32 = NDArray[np.float32]


def floats(array: ArrayLike) -> Floats32:
    """``array`` as kernels need it: float32, contiguous, aligned, writable; copied only if needed."""
    if type(array) is np.ndarray and array.dtype == np.float32 and array.flags.carray:
        return array
    return np.require(array, np.float32, ["C", "A", "W"])


def mask(chosen: ArrayLike | None, count: int) -> NDArray[np.bool_]:
    """Boolean mask [``count``] of ``chosen`` Gaussians; all by default."""
    if chosen is None:
        return np.ones(count, np.bool_)
    given = np.require(chosen, np.bool_, ["C", "A", "W"])
    check_shape("chosen Gaussians", given, (count,))
    return given


def check_shape(what: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise ``InputError`` for another shape; kernels do not check bounds."""
    if array.shape != shape:
        raise InputError(what, expected=f"shape {shape}", got=f"{array.shape}")


def checked(
    means: ArrayLike, covariances: ArrayLike, opacities: ArrayLike, features: ArrayLike
) -> tuple[Floats32, Floats32, Floats32, Floats32]:
    """``floats`` of arrays of shapes [N, 3], [N, 6], [N] and [N, C]; ``InputError`` for other shapes."""
    arrays = floats(means), floats(covariances), floats(opacities), floats(features)
    count = len(arrays[0]) if arrays[0].ndim else 0
    channels = arrays[3].shape[-1] if arrays[3].ndim else 0
    shapes = {"means": (count, 3), "covariances": (count, 6), "opacities": (count,), "features": (count, channels)}
    for array, (name, shape) in zip(arrays, shapes.items()):
        check_shape(name, array, shape)
    return arrays


def shallow_copy(original: T, **changes: Any) -> T:
    """A copy of an object, frozen or not, with other attributes; no check of its class runs."""
    copied = object.__new__(type(original))
    copied.__dict__.update(original.__dict__, **changes)
    return copied


def spaced_indices(count: int, number: int) -> NDArray[np.int64]:
    """Indices of at most ``number`` of ``count`` elements, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(number, count)).astype(np.int64))


class Buffers:
    """Arrays of one size after another, each handed out again once nobody else holds it or a view of it.

    Fresh memory of an image's size costs a page fault every 4 KiB: 2 ms for 512² pixels on a virtual machine.
    """

    def __init__(self) -> None:
        self._arrays: list[Floats32] = []

    def empty(self, shape: tuple[int, ...]) -> Floats32:
        """An uninitialised array of ``shape``."""
        self._arrays = [array for array in self._arrays if array.shape == shape]
        for index in range(len(self._arrays)):
            if sys.getrefcount(self._arrays[index]) <= _UNHELD:
                return self._arrays[index]
        self._arrays.append(np.empty(shape, np.float32))
        return self._arrays[-1]


_HELD_BY_A_LIST = [np.empty(0)]
_UNHELD = sys.getrefcount(_HELD_BY_A_LIST[0])
"""references to an array that a list alone holds, with those of the question"""
