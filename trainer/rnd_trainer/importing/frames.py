"""The frames of a video, by number, through PyAV."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

from .images import Bytes

_KEPT = 3  # frames behind the reader: masks and pictures of one frame are asked for one after the other


class Film:
    """Frames [H, W, 3] uint8 sRGB of a video file, upright, decoded when asked for; cheap in ascending order.

    Attributes:
        width, height: pixels, after the file's rotation.
        fps: frames per second, on average.
        count: frames, all decoded once for it: packets may hold frames that a cut (an edit list) leaves out;
            ``numbers`` counts them from 0.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = existing_file(path, what="video")
        if importlib.util.find_spec("av") is None:
            raise InputError("PyAV is not installed", hint='pip install "rnd-avatar[video]", in a clone ".[video]"')
        container = self._open()
        with container:
            stream = container.streams.video[0]
            self.fps = float(stream.average_rate or 30)
            frames = self._decode(container)
            first = next(frames, None)
            if first is None:
                raise InputError("video", expected="at least one frame", got="none", file=self.path)
            self.height, self.width = _upright(first).shape[:2]
            self.count = 1 + sum(1 for _ in frames)
        self.numbers = range(self.count)
        self._kept: dict[int, Bytes] = {}
        self._frames: Iterator[Any] | None = None
        self._next = 0

    def frame(self, number: int) -> Bytes:
        """Frame ``number``, counted from 0."""
        if number in self._kept:
            return self._kept[number]
        if self._frames is None or number < self._next:
            self._frames, self._next = self._decode(self._open()), 0
        for decoded in self._frames:
            place, self._next = self._next, self._next + 1
            pixels = _upright(decoded)
            self._kept[place] = pixels
            self._kept.pop(place - _KEPT, None)
            if place == number:
                self._kept = {k: v for k, v in self._kept.items() if place - _KEPT < k <= place}
                return pixels
        raise InputError("video ends", expected=f"frame {number}", got=f"{self._next} frames", file=self.path)

    def name(self, number: int) -> str:
        """Of the file of frame ``number``: it has none of its own."""
        return ""

    def _open(self) -> Any:
        import av

        try:
            container = av.open(str(self.path))
        except (av.error.FFmpegError, OSError) as error:
            raise InputError("video cannot be read", got=str(error), file=self.path) from error
        if not container.streams.video:
            raise InputError("video", expected="a video stream", got="none", file=self.path)
        return container

    def _decode(self, container: Any) -> Iterator[Any]:
        import av

        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        try:
            yield from container.decode(stream)
        except av.error.FFmpegError as error:
            raise InputError("video cannot be decoded", got=str(error), file=self.path) from error


def _upright(frame: Any) -> Bytes:
    pixels = _rgb(frame)
    turns = round(-getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(pixels, -turns)) if turns else pixels


def _rgb(frame: Any) -> Bytes:
    """sRGB of a decoded frame by the matrix its stream names; BT.709 from 720 lines on, BT.601 below, unnamed."""
    named = {1: "itu709", 5: "itu601", 6: "itu601", 9: "bt2020"}.get(int(frame.colorspace))
    matrix = named or ("itu709" if frame.height >= 720 else "itu601")
    pixels: Bytes = frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    return pixels
