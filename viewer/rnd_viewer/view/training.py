"""A folder of ``rnd-train``, read while it grows: progress, losses, previews, and the avatar once exported."""

from __future__ import annotations

import json
import os
import re
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from rnd_runtime.core.files import existing_file

from .options import ViewOptions
from .scene import Scene

METRICS, STATUS, CONFIG, PREVIEWS = "metrics.jsonl", "status.json", "config.json", "previews"
AVATAR = "avatar.onnx"
POINTS = 300  # of a curve, as many as its pixels
_PREVIEW = re.compile(r"step_\d+\.png")
_NO_LOSSES = ("step", "stage", "seconds", "skipped")


class Training:
    """Watches the run ``options.avatar``; several threads may ask.

    Raises:
        InputError: the folder holds no training.
    """

    def __init__(self, options: ViewOptions) -> None:
        self.folder = options.avatar
        self._options = replace(options, avatar=self.folder / AVATAR)
        existing_file(self.folder / CONFIG, what="config.json of rnd-train")
        self._rows: list[dict[str, Any]] = []
        self._file, self._offset = 0, 0
        self._scenes: dict[int, Scene] = {}  # by the avatar file's time of change
        self._reading, self._loading = threading.Lock(), threading.Lock()

    def state(self) -> dict[str, Any]:
        """Content of the page: the status of rnd-train, a curve ``[[step, mean], …]`` for each loss, file names."""
        with self._reading:
            rows = self._read_metrics()
        status, last = _json(self.folder / STATUS), rows[-1] if rows else {}
        return {
            "name": self.folder.resolve().name,
            "phase": status.get("phase"),
            "done": status.get("step", last.get("step", -1) + 1),
            "total": status.get("steps", 1),
            "seconds": status.get("seconds", 0),
            "seconds_left": status.get("seconds_left"),
            "ended": status.get("ended"),
            "silent_s": self._silence(),
            "skipped": sum("skipped" in row for row in rows),
            "curves": _curves(rows),
            "previews": self._previews(),
            "avatar": (self.folder / AVATAR).is_file(),
        }

    def preview(self, name: str) -> bytes | None:
        """The preview image ``name``, or None."""
        file = self.folder / PREVIEWS / name
        return file.read_bytes() if _PREVIEW.fullmatch(name) and file.is_file() else None

    def scene(self) -> Scene:
        """The avatar as it is now, loaded when it is first asked for and after each export.

        Raises:
            InputError: it is not exported yet, or something else cannot be used.
        """
        file = existing_file(self._options.avatar, what="avatar of the run")
        with self._loading:
            stamp = file.stat().st_mtime_ns
            if stamp not in self._scenes:
                self._scenes[stamp] = Scene(self._options)
            return self._scenes[stamp]

    def close(self) -> None:
        for scene in self._scenes.values():
            scene.close()

    def _read_metrics(self) -> list[dict[str, Any]]:
        """All complete rows so far; a file replaced by --resume is read again."""
        try:
            with (self.folder / METRICS).open("rb") as stream:
                file = os.fstat(stream.fileno()).st_ino
                if file != self._file:
                    self._rows, self._offset, self._file = [], 0, file
                stream.seek(self._offset)
                content = stream.read()
        except FileNotFoundError:
            return []
        complete = content[: content.rfind(b"\n") + 1]
        self._offset += len(complete)
        self._rows += [row for line in complete.splitlines() if isinstance((row := _parse(line)).get("step"), int)]
        return self._rows

    def _previews(self) -> list[str]:
        """File names, the first step first."""
        folder = self.folder / PREVIEWS
        return sorted(file.name for file in folder.glob("step_*.png")) if folder.is_dir() else []

    def _silence(self) -> float | None:
        """Seconds since rnd-train's last write."""
        times = [file.stat().st_mtime for name in (METRICS, STATUS) if (file := self.folder / name).exists()]
        return max(time.time() - max(times), 0) if times else None


def _parse(text: str | bytes) -> dict[str, Any]:
    """A JSON object; empty for anything else, such as a truncated line."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _json(file: Path) -> dict[str, Any]:
    try:
        return _parse(file.read_bytes())
    except FileNotFoundError:
        return {}


def _curves(rows: list[dict[str, Any]]) -> dict[str, list[list[float]]]:
    """``[[step, mean], …]`` of every loss, finite values only, at most ``POINTS`` each."""
    width = -(-(rows[-1]["step"] + 1) // POINTS) if rows else 1
    bins: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        for name, value in row.items():
            if name not in _NO_LOSSES and isinstance(value, int | float) and abs(value) < float("inf"):
                bins.setdefault(name, {}).setdefault(row["step"] // width, []).append(value)
    return {
        name: [[width * k + width / 2, sum(values) / len(values)] for k, values in sorted(parts.items())]
        for name, parts in bins.items()
    }
