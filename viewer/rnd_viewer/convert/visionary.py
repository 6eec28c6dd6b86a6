"""A clip as one ONNX file from time to plain Gaussians, for Visionary's WebGPU renderer.

Input ``time`` [1]; outputs ``gaussian_f32`` [N, 10] (position, opacity, covariance xx xy xz yy yz zz), ``color_rgb``
[N, 4] in sRGB and ``num_points`` [1], int32. float32, as half floats lose a thin Gaussian's variance of 1e-8 m². The
file holds the clip's frames and picks floor(time · fps), repeated. It is written field by field (onnx.proto of IR
version 8), without a package for ONNX.

Source: arXiv 2512.08478, section 3, and the exporters beside its source.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime import __version__
from rnd_runtime.avatar.onnx_parts import bytes_field, number_field
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.rotations import quaternion_to_matrix

from .splats import SH_0, Splats

Floats32 = NDArray[np.float32]

MAX_BYTES = 1 << 27  # of one table: WebGPU's default limit of a storage buffer
ROW_BYTES = 40
_IR_VERSION, _OPSET = 8, 18
_FLOAT, _INT32, _INT64 = 1, 6, 7  # TensorProto.DataType
_ATTRIBUTE_INT = 2  # AttributeProto.AttributeType
_LATE = 1e-3  # of a frame, so that rounded times select their frame


def packed(splats: Splats) -> tuple[Floats32, Floats32]:
    """Rows ``gaussian`` [N, 10] and ``color`` [N, 4] of splats with a view-independent colour."""
    factors = quaternion_to_matrix(splats.quaternions) * splats.scales[:, None, :]
    covariances = factors @ np.swapaxes(factors, 1, 2)
    rows, columns = np.triu_indices(3)
    gaussians = np.concatenate([splats.means, splats.opacities[:, None], covariances[:, rows, columns]], axis=1)
    colours = 0.5 + SH_0 * splats.sh[:, 0]
    return gaussians.astype(np.float32), np.pad(colours, ((0, 0), (0, 1)), constant_values=1).astype(np.float32)


def check_clip(frames: int, gaussians: int) -> None:
    """Refuse a clip too large for a WebGPU buffer."""
    limit = MAX_BYTES // (gaussians * ROW_BYTES)
    if frames > limit:
        raise InputError("--frames", expected=f"at most {limit} of this avatar for visionary", got=frames)


def write_visionary(path: Path, frames: Sequence[tuple[Floats32, Floats32]], fps: float) -> None:
    """Write a clip of ``frames``, each as ``packed``.

    Raises:
        InputError: the frames have different numbers of Gaussians.
    """
    counts = [len(gaussians) for gaussians, _ in frames]
    if min(counts) < max(counts):
        got = f"{min(counts)} to {max(counts)}"
        raise InputError("visionary", expected="as many finite Gaussians in every frame", got=got, file=path)
    gaussians, colours = (np.stack(parts) for parts in zip(*frames))
    with atomic_path(path) as temporary:
        temporary.write_bytes(_model(gaussians, colours, fps))


def _model(gaussians: Floats32, colours: Floats32, fps: float) -> bytes:
    count, points = gaussians.shape[:2]
    constants: dict[str, NDArray[Any]] = {
        "gaussian_frames": gaussians,
        "color_frames": colours,
        "fps": np.array([fps], np.float32),
        "late": np.array([_LATE], np.float32),
        "half": np.array([0.5], np.float32),
        "frames": np.array([count], np.float32),
        "gaussian_shape": np.array([points, 10], np.int64),
        "color_shape": np.array([points, 4], np.int64),
        "points": np.array([points], np.int32),
    }
    nodes = [
        _node("Mul", ["time", "fps"], "exact_frame"),
        _node("Add", ["exact_frame", "late"], "late_frame"),
        _node("Floor", ["late_frame"], "frame"),
        _node("Add", ["frame", "half"], "frame_middle"),  # robust against rounding of the ratio
        _node("Div", ["frame_middle", "frames"], "clips"),
        _node("Floor", ["clips"], "whole_clips"),
        _node("Mul", ["whole_clips", "frames"], "clip_start"),
        _node("Sub", ["frame", "clip_start"], "frame_of_clip"),
        _node("Cast", ["frame_of_clip"], "index", to=_INT32),
        _node("Gather", ["gaussian_frames", "index"], "one_gaussian_frame", axis=0),
        _node("Gather", ["color_frames", "index"], "one_color_frame", axis=0),
        _node("Reshape", ["one_gaussian_frame", "gaussian_shape"], "gaussian_f32"),
        _node("Reshape", ["one_color_frame", "color_shape"], "color_rgb"),
        _node("Identity", ["points"], "num_points"),
    ]
    outputs = [("gaussian_f32", _FLOAT, [points, 10]), ("color_rgb", _FLOAT, [points, 4]), ("num_points", _INT32, [1])]
    graph = [*(bytes_field(1, node) for node in nodes), _text(2, "clip")]
    graph += [bytes_field(5, _tensor(name, values)) for name, values in constants.items()]
    graph.append(bytes_field(11, _value("time", _FLOAT, [1])))
    graph += [bytes_field(12, _value(*output)) for output in outputs]
    opset = bytes_field(8, _text(1, "") + number_field(2, _OPSET))
    head = number_field(1, _IR_VERSION) + _text(2, "rnd-avatar") + _text(3, __version__)
    return head + bytes_field(7, b"".join(graph)) + opset


def _text(number: int, text: str) -> bytes:
    return bytes_field(number, text.encode())


def _node(kind: str, inputs: Sequence[str], output: str, **attributes: int) -> bytes:
    """A NodeProto."""
    parts = [*(_text(1, name) for name in inputs), _text(2, output), _text(3, output), _text(4, kind)]
    for name, value in attributes.items():
        attribute = _text(1, name) + number_field(3, value) + number_field(20, _ATTRIBUTE_INT)
        parts.append(bytes_field(5, attribute))
    return b"".join(parts)


def _tensor(name: str, values: NDArray[Any]) -> bytes:
    """A TensorProto."""
    kind = {"f": _FLOAT, "i": _INT32 if values.itemsize == 4 else _INT64}[values.dtype.kind]
    shape = b"".join(number_field(1, size) for size in values.shape)
    raw = values.astype(values.dtype.newbyteorder("<")).tobytes()
    return shape + number_field(2, kind) + _text(8, name) + bytes_field(9, raw)


def _value(name: str, kind: int, shape: Sequence[int]) -> bytes:
    """A ValueInfoProto."""
    sizes = b"".join(bytes_field(1, number_field(1, size)) for size in shape)
    tensor = number_field(1, kind) + bytes_field(2, sizes)
    return _text(1, name) + bytes_field(2, bytes_field(1, tensor))
