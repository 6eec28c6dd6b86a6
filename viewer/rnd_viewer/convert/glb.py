"""glTF 2.0 binary containers: JSON, then one buffer of aligned arrays."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rnd_runtime.core.files import atomic_path

FLOAT, UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5121, 5123, 5125
_DTYPES = {FLOAT: "<f4", UNSIGNED_BYTE: "u1", UNSIGNED_SHORT: "<u2", UNSIGNED_INT: "<u4"}
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class GlbBuilder:
    """Accessors and images of a file."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []
        self._length = 0

    def accessor(
        self, values: ArrayLike, kind: str, component: int, *, target: int | None = ARRAY_BUFFER, bounds: bool = False
    ) -> int:
        """Store ``values`` [count, …] of glTF type ``kind`` and return the accessor's index.

        ``bounds`` adds the minimum and maximum that glTF requires of positions and key times; ``target`` is None
        except for vertex attributes and indices.
        """
        array = np.ascontiguousarray(values, _DTYPES[component])
        accessor = {"bufferView": len(self._views), "componentType": component, "count": len(array), "type": kind}
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self._append(array.tobytes(), {} if target is None else {"target": target})
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def image(self, png: bytes) -> int:
        """Store a PNG file's ``png`` and return the image's index."""
        self._images.append({"bufferView": len(self._views), "mimeType": "image/png"})
        self._append(png, {})
        return len(self._images) - 1

    def _append(self, content: bytes, view: dict[str, Any]) -> None:
        self._views.append({"buffer": 0, "byteOffset": self._length, "byteLength": len(content)} | view)
        chunk = content + bytes(-len(content) % 4)
        self._chunks.append(chunk)
        self._length += len(chunk)

    def write(self, path: Path, document: dict[str, Any]) -> None:
        """Write ``document`` with its arrays; the same arrays give the same bytes."""
        document = {
            "asset": {"version": "2.0", "generator": "RnD-Avatar"},
            **document,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._length}],
        }
        if self._images:
            document["images"] = self._images
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        parts = [
            struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self._length),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", self._length, b"BIN\0"),
            *self._chunks,
        ]
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"".join(parts))
