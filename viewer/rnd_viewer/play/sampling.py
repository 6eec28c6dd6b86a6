"""Frames that are means of several: supersampled in space, and in time while a shutter is open.

Means are of linear, premultiplied light, so what is shown is the mean of what the samples would show.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.playback.frame import RenderedFrame

_TURN = 360  # degrees of a shutter that is open for the whole frame
_UNSEEN = 1e-6  # share of a pixel up to which what is behind the body is of no consequence


@dataclass(frozen=True)
class Sampling:
    """How a frame is sampled.

    Attributes:
        factor: samples along a pixel's side.
        shutter: degrees for which the shutter is open around a frame's moment, 360 for its duration; 0 for a moment.
        count: samples in that time.
    """

    factor: int = 1
    shutter: float = 0.0
    count: int = 1

    @cached_property
    def offsets(self) -> list[float]:
        """Frames from a frame's moment to those of its samples."""
        count = self.count if self.shutter else 1
        return [self.shutter / _TURN * ((k + 0.5) / count - 0.5) for k in range(count)]

    def fine(self, camera: Camera) -> Camera:
        """``camera`` with all the samples as pixels."""
        return camera if self.factor == 1 else camera.resized(self.factor * camera.width, self.factor * camera.height)

    def mean(self, frames: Iterable[RenderedFrame]) -> RenderedFrame:
        """The mean of the samples ``frames``, without AOVs; of one frame of a sample a pixel that frame."""
        if self.factor == len(self.offsets) == 1:
            return next(iter(frames))
        share = 1 / len(self.offsets)
        total: list[Floats32] = []
        seconds: dict[str, float] = {}
        for frame in frames:
            parts = [self._box(part) * np.float32(share) for part in _parts(frame)]
            total = [one + other for one, other in zip(total, parts)] if total else parts
            for stage, spent in frame.stage_seconds.items():
                seconds[stage] = seconds.get(stage, 0.0) + spent
        radiance, alpha, *behind = total
        ground, background = frame.ground, frame.background
        if ground is not None or _is_map(background):
            clear, lit, seen = behind
            if ground is not None:
                ground = np.divide(lit, clear, out=np.ones_like(lit), where=clear > _UNSEEN)
            if _is_map(background):
                background = np.divide(seen, lit, out=np.zeros_like(lit), where=lit > _UNSEEN)
        return replace(
            frame,
            radiance=radiance,
            alpha=alpha,
            stage_seconds=seconds,
            ground=ground,
            background=background,
            srgb_on_black=None,
        )

    def _box(self, layer: Floats32) -> Floats32:
        """Means [H, W, …] of the samples [factor · H, factor · W, …] of each pixel."""
        s = self.factor
        if s == 1:
            return layer
        total = np.zeros_like(layer[::s, ::s])
        for row in range(s):
            for column in range(s):
                total += layer[row::s, column::s]
        return total / np.float32(s * s)


def _is_map(background: Floats32 | None) -> bool:
    return background is not None and background.ndim == 3


def _parts(frame: RenderedFrame) -> list[Floats32]:
    """What is averaged: radiance and alpha; the share of a pixel behind the body, of its light, and that light."""
    if frame.ground is None and not _is_map(frame.background):
        return [frame.radiance, frame.alpha]
    clear = np.repeat(np.maximum(1 - frame.alpha, 0)[..., None], 3, axis=-1)
    lit = clear if frame.ground is None else clear * frame.ground
    return [frame.radiance, frame.alpha, clear, lit, lit if frame.background is None else lit * frame.background]
