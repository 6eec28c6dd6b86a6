"""OpenCV's calibration files, read by PyYAML: ``cv2.FileStorage`` corrupts the heap on a damaged matrix.

Source: the YAML 1.0 that OpenCV's FileStorage writes; a matrix is ``!!opencv-matrix {rows, cols, dt, data}``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

MAX_BYTES = 1 << 22
"""largest calibration file, ten thousand cameras"""
MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with OpenCV's matrices as mappings."""


_Loader.add_constructor(MATRIX_TAG, lambda loader, node: loader.construct_mapping(node, deep=True))


class Calibration:
    """Top-level entries of one file; failures are ``InputError`` with file and key."""

    def __init__(self, path: str | Path) -> None:
        self.path = existing_file(path, what="calibration")
        if self.path.stat().st_size > MAX_BYTES:
            raise InputError("calibration", expected=f"at most {MAX_BYTES} bytes", got="more", file=self.path)
        self._entries = self._parsed()

    def _parsed(self) -> dict[Any, Any]:
        try:
            first, _, rest = self.path.read_text(encoding="utf-8").partition("\n")
            text = rest if first.startswith("%YAML") else f"{first}\n{rest}"
            if "&" in text:  # anchors: nested aliases grow exponentially
                raise ValueError("anchor")
            entries = yaml.load(text, _Loader)  # a SafeLoader
        except (yaml.YAMLError, ValueError, OverflowError, RecursionError, TypeError, AttributeError) as error:
            raise InputError("calibration", expected="OpenCV's YAML", got="another text", file=self.path) from error
        if not isinstance(entries, dict):
            raise InputError("calibration", expected="keys and matrices", got=type(entries).__name__, file=self.path)
        return entries

    def strings(self, key: str) -> list[str]:
        """List of strings under ``key``, or empty."""
        value = self._entries.get(key)
        return [str(item) for item in value if isinstance(item, str | int)] if isinstance(value, list) else []

    def matrix(self, key: str) -> NDArray[np.float64]:
        """The matrix [rows, cols] under ``key``."""
        found = self.optional_matrix(key)
        if found is None:
            raise InputError(
                "calibration", expected=key, got=f"only {', '.join(map(str, self._entries))}", file=self.path
            )
        return found

    def optional_matrix(self, key: str) -> NDArray[np.float64] | None:
        """As ``matrix``; None without ``key``."""
        if key not in self._entries:
            return None
        entry = self._entries[key]
        if not isinstance(entry, dict):
            raise InputError(key, expected="a matrix", got=type(entry).__name__, file=self.path)
        missing = [name for name in ("rows", "cols", "data") if name not in entry]
        if missing:
            raise InputError(
                f"{key}: {missing[0]} is missing", got=f"only {', '.join(map(str, entry))}", file=self.path
            )
        rows, cols, data = entry["rows"], entry["cols"], entry["data"]
        if not all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in (rows, cols)):
            raise InputError(
                f"{key}: rows and cols", expected="positive whole numbers", got=f"{rows}, {cols}", file=self.path
            )
        if not isinstance(data, list) or len(data) != rows * cols:
            got = f"{len(data)}" if isinstance(data, list) else type(data).__name__
            raise InputError(f"{key}: data", expected=f"{rows} × {cols} numbers", got=got, file=self.path)
        try:
            numbers = np.array([float(item) for item in data], np.float64).reshape(rows, cols)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{key}: data", expected="numbers", got="something else", file=self.path) from error
        if not np.isfinite(numbers).all():
            raise InputError(f"{key}: data", expected="finite numbers", got="others", file=self.path)
        return numbers
