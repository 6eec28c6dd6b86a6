"""Frames of a video file by number, decoded by PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_trainer.importing.images import Bytes
from rnd_trainer.importing.videos.video_colour import colour_notes, to_srgb

_CACHED = 3  # latest frames: image and mask of a frame are read in sequence


class VideoFile:
    """Frames [H, W, 3] uint8 sRGB, upright, decoded on demand; cheap in ascending order.

    Attributes:
        width, height: pixels, after the file's rotation.
        fps: frames per second, on average.
        numbers: of the frames, from 0; counted by decoding, as an edit list may skip packets.
        notes: conversions of colour, one sentence each.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = existing_file(path, what="video")
        need_packages("video", "av", what="videos need")
        with self._open() as container:
            self.fps = float(container.streams.video[0].average_rate or 30)
            frames = self._decode(container)
            first = next(frames, None)
            if first is None:
                raise InputError("video", expected="at least one frame", got="none", file=self.path)
            try:
                self.notes = colour_notes(first)
                self.height, self.width = _upright(first).shape[:2]
            except InputError as error:
                raise error.at(file=self.path) from error
            self.numbers = range(1 + sum(1 for _ in frames))
        self._cache: dict[int, Bytes] = {}
        self._frames: Iterator[Any] | None = None
        self._next = 0

    def frame(self, number: int) -> Bytes:
        """Frame ``number``, counted from 0."""
        if number in self._cache:
            return self._cache[number]
        if self._frames is None or number < self._next:
            self._frames, self._next = self._decode(self._open()), 0
        for decoded in self._frames:
            current, self._next = self._next, self._next + 1
            if current > number - _CACHED:
                self._cache[current] = _upright(decoded)
            if current == number:
                self._cache = {k: v for k, v in self._cache.items() if current - _CACHED < k <= current}
                return self._cache[number]
        raise InputError("video ends", expected=f"frame {number}", got=f"{self._next} frames", file=self.path)

    def name(self, number: int) -> str:
        """Empty: a video's frames have no files."""
        return ""

    def _open(self) -> Any:
        import av

        try:
            container = av.open(str(self.path), metadata_errors="replace")
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
    """Pixels in sRGB, rotated and mirrored as the file's display matrix says."""
    pixels = to_srgb(frame)
    matrix = _display_matrix(frame)
    if matrix is None:
        quarters = round(-getattr(frame, "rotation", 0) / 90) % 4
        return np.ascontiguousarray(np.rot90(pixels, -quarters)) if quarters else pixels
    if not matrix[0, 0]:  # x and y change places
        pixels = pixels.swapaxes(0, 1)
    right, down = matrix.sum(0)
    return np.ascontiguousarray(pixels[::down, ::right])


def _display_matrix(frame: Any) -> NDArray[np.int64] | None:
    """[2, 2] of −1, 0 and 1, the columns of which stored x and y make shown x and y; None without one.

    Raises:
        InputError: it is not made of quarter rotations and mirrors.
    """
    found = next((data for data in frame.side_data if data.type.name == "DISPLAYMATRIX"), None)
    if found is None:
        return None
    numbers = np.frombuffer(bytes(found), "<i4")[:9].reshape(3, 3)[:2, :2].astype(np.float64)
    scale = np.abs(numbers).max()
    matrix = np.round(numbers / scale if scale else numbers).astype(np.int64)
    if np.abs(numbers - scale * matrix).max() > 0.01 * scale or abs(round(np.linalg.det(matrix))) != 1:
        got = np.round(numbers / 65536, 3).tolist()
        raise InputError("display matrix of the video", expected="quarter rotations and mirrors", got=got)
    return matrix
