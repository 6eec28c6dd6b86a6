"""Somebody's image network in ONNX: one picture in, one map of the same extent out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

_FREE_SIZE = 512  # pixels, for networks that take any
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class ImageNetwork:
    """A network from one sRGB picture to one map, whatever its size and axis order.

    Takes N×3×H×W and N×H×W×3, fixed or free sizes, float32 and float16 in [0, 1] or uint8; the first output must
    have four axes, or three without the channels', in the input's axis order. Whether its author meant [0, 1] or
    normalised colours is not in the file: [0, 1] is what is fed unless ``mean`` and ``std`` are given.

    Args:
        outputs: how many channels the map may have.

    Raises:
        InputError: when the file is no such network.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        outputs: tuple[int, ...],
        mean: tuple[float, float, float] = (0.0, 0.0, 0.0),
        std: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.path = existing_file(path, what="network")
        self._mean, self._std = np.array(mean, np.float32), np.array(std, np.float32)
        self._outputs = outputs
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(self.path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base
            raise InputError("network", expected="an ONNX file", got=str(error)[:200], file=path) from error
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or 3 not in (shape[1], shape[3]) or inputs[0].type not in _TYPES:
            got = "; ".join(f"{one.name} {one.shape} {one.type}" for one in inputs)
            raise InputError("network's input", expected="one picture, N×3×H×W or N×H×W×3", got=got, file=path)
        self._name, self._dtype = inputs[0].name, _TYPES[inputs[0].type]
        self._channels_first = shape[1] == 3
        height, width = shape[2:] if self._channels_first else shape[1:3]
        self._size = tuple(side if isinstance(side, int) else _FREE_SIZE for side in (width, height))

    def __call__(self, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The map [H, W, C] of ``picture`` [H, W, 3] uint8 sRGB, resized to its extent."""
        height, width = picture.shape[:2]
        tensor = cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA)
        if self._dtype is not np.uint8:
            tensor = ((tensor.astype(np.float32) / 255 - self._mean) / self._std).astype(self._dtype)
        tensor = tensor.transpose(2, 0, 1) if self._channels_first else tensor
        try:
            output = np.asarray(self._session.run(None, {self._name: tensor[None]})[0], np.float32)
        except Exception as error:
            raise InputError("network", expected="to run", got=str(error)[:200], file=self.path) from error
        if output.ndim == 3:
            output = output[:, None] if self._channels_first else output[..., None]
        if output.ndim == 4 and self._channels_first:
            output = output.transpose(0, 2, 3, 1)
        if output.ndim != 4 or output.shape[3] not in self._outputs or not np.isfinite(output).all():
            wanted = " or ".join(map(str, self._outputs))
            raise InputError(
                "network's output", expected=f"a map of {wanted} channels", got=list(output.shape), file=self.path
            )
        resized = cv2.resize(output[0], (width, height), interpolation=cv2.INTER_LINEAR)
        return resized.reshape(height, width, -1)
