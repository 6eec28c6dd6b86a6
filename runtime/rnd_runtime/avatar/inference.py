"""Sessions of onnxruntime: on this process's cores, without its telemetry, errors in one line."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError, first_line
from rnd_runtime.core.threads import cores


def open_session(model: bytes | Path, threads: int | None = None) -> Any:
    """An ``onnxruntime.InferenceSession`` of ``model`` on ``threads``, by default one per core.

    Raises:
        InputError: ``model`` is no ONNX model.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # sent by default from 1.29 on; read as the library loads
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or cores()
    options.inter_op_num_threads = 1
    # Threads may spin for the gap between two operations; longer would take the cores from the kernels that follow.
    options.add_session_config_entry("session.intra_op.spin_duration_us", "50")
    options.log_severity_level = 4  # an error's first line is in ours
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no base
        raise InputError("not a readable ONNX model", got=first_line(error)) from error


def run_session(session: Any, outputs: Sequence[str] | None, inputs: Mapping[str, NDArray[Any]]) -> list[Any]:
    """The ``outputs``, all when None, of ``session`` for ``inputs``.

    Raises:
        InputError: the graph cannot be evaluated.
    """
    try:
        results: list[Any] = session.run(None if outputs is None else list(outputs), dict(inputs))
        return results
    except Exception as error:
        raise InputError("graph cannot be evaluated", got=first_line(error)) from error
