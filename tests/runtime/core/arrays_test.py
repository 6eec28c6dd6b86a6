"""Arrays that are handed out again."""

from __future__ import annotations

from rnd_runtime.core.arrays import Buffers


def test_an_array_is_handed_out_again_when_nobody_holds_it():
    buffers = Buffers()
    first = buffers.empty((4, 3))
    second = buffers.empty((4, 3))
    assert first is not second
    at, view = second.ctypes.data, second[1:]
    del second
    assert buffers.empty((4, 3)).ctypes.data != at  # a view holds it
    del view
    assert buffers.empty((4, 3)).ctypes.data == at
    assert buffers.empty((2, 3)).shape == (2, 3)
