"""The converter's own arithmetic: sparse weights and TensorFlow's padding, against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_trainer.estimating.observing import tflite_onnx

pytest.importorskip("tflite")


def test_sparse_rows_become_dense(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    dense = np.where(rng.uniform(size=(4, 1, 1, 6)) < 0.4, rng.normal(size=(4, 1, 1, 6)), 0).astype(np.float16)
    dense[2] = 0  # a row without values
    rows = dense.reshape(-1, 6)
    segments = np.concatenate([[0], np.cumsum((rows != 0).sum(1))])
    monkeypatch.setattr(tflite_onnx, "_row_index", lambda sparsity, axis: (segments, np.nonzero(rows)[1]))
    np.testing.assert_array_equal(tflite_onnx._dense(rows[rows != 0], [4, 1, 1, 6], None), dense)


@pytest.mark.parametrize("side, kernel, stride", [(8, 3, 1), (8, 3, 2), (7, 3, 2), (9, 5, 2), (6, 2, 2), (5, 2, 2)])
def test_padding_is_tensorflows(side: int, kernel: int, stride: int) -> None:
    conversion = object.__new__(tflite_onnx._Conversion)
    conversion._shape = lambda index: [1, side, side, 3]  # type: ignore[method-assign]
    top, left, bottom, right = conversion._pads(0, 0, [kernel, kernel], [stride, stride], [1, 1])
    assert (top, bottom) == (left, right) and bottom - top in (0, 1)
    positions = (side + top + bottom - kernel) // stride + 1
    assert positions == -(-side // stride)  # as many as strides fit
    assert (side + top + bottom - kernel) % stride == 0 or top + bottom == 0  # not more than is needed
    assert conversion._pads(1, 0, [kernel, kernel], [stride, stride], [1, 1]) == [0, 0, 0, 0]
