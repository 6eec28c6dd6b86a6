"""Image networks in ONNX: from an image to a map."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.inference import open_session, run_session
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

_FREE_SIZE = 512  # pixels, for networks that take any
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class ImageNetwork:
    """A network from one sRGB image to one map, of any size and axis order.

    Takes N×3×H×W and N×H×W×3, fixed or free sizes, float32 and float16 in [0, 1] or uint8. The first output has four
    axes, or three without the channels', in the input's axis order.

    Args:
        outputs: numbers of channels that the map may have.

    Raises:
        InputError: not such a network.
    """

    def __init__(self, path: str | Path, *, outputs: tuple[int, ...]) -> None:
        self.path = existing_file(path, what="network")
        self._outputs = outputs
        try:
            self._session = open_session(self.path)
        except InputError as error:
            raise error.at(file=path) from error
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or 3 not in (shape[1], shape[3]) or inputs[0].type not in _TYPES:
            got = "; ".join(f"{one.name} {one.shape} {one.type}" for one in inputs)
            raise InputError("network's input", expected="one image, N×3×H×W or N×H×W×3", got=got, file=path)
        self._name, self._dtype = inputs[0].name, _TYPES[inputs[0].type]
        self._channels_first = shape[1] == 3
        height, width = shape[2:] if self._channels_first else shape[1:3]
        self._size = tuple(side if isinstance(side, int) else _FREE_SIZE for side in (width, height))

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The map [H, W, C] of ``image`` [H, W, 3] uint8 sRGB, resized to its extent."""
        height, width = image.shape[:2]
        tensor = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        if self._dtype is not np.uint8:
            tensor = (tensor.astype(np.float32) / 255).astype(self._dtype)
        tensor = tensor.transpose(2, 0, 1) if self._channels_first else tensor
        try:
            output = np.asarray(run_session(self._session, None, {self._name: tensor[None]})[0], np.float32)
        except InputError as error:
            raise error.at(file=self.path) from error
        if output.ndim == 3:
            output = output[:, None] if self._channels_first else output[..., None]
        if output.ndim == 4 and self._channels_first:
            output = output.transpose(0, 2, 3, 1)
        if not np.isfinite(output).all():
            raise InputError("network's output", expected="finite numbers", got="NaN or infinity", file=self.path)
        if output.ndim != 4 or output.shape[3] not in self._outputs:
            expected = f"a map of {' or '.join(map(str, self._outputs))} channels"
            raise InputError("network's output", expected=expected, got=list(output.shape), file=self.path)
        resized = cv2.resize(output[0], (width, height), interpolation=cv2.INTER_LINEAR)
        return resized.reshape(height, width, -1)

    def of_person(self, image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The map [H, W, C] of a crop of the person on grey; zero outside the crop.

        Args:
            image: [H, W, 3] uint8 sRGB.
            mask: [H, W] uint8 coverage.
        """
        output = np.zeros((*mask.shape, self._outputs[0]), np.float32)
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if len(rows):
            margin = (rows[-1] - rows[0]) // 10 + 2
            box = tuple(slice(max(int(side[0]) - margin, 0), int(side[-1]) + 1 + margin) for side in (rows, columns))
            alpha = mask[box][..., None] / np.float32(255)
            output[box] = self(np.round(image[box] * alpha + 128 * (1 - alpha)).astype(np.uint8))
        return output
