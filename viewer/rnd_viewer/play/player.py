"""Poses, relights and splats one frame at a time, over a background."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Encoded
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.shading.light import Light
from rnd_viewer.inputs.background import Background

from .timing import StageTimes

Floats32 = NDArray[np.float32]


@dataclass(eq=False)
class Player:
    """Frames of a ``FrameRenderer`` over a background; ``times`` collects how long each stage took."""

    renderer: FrameRenderer
    background: Background = field(default_factory=Background)
    aovs: tuple[str, ...] = ()
    times: StageTimes = field(default_factory=StageTimes)
    _backdrop: tuple[Camera, Light, Floats32] | None = field(default=None, init=False, repr=False)

    def render(self, motion: Motion, time_s: float, camera: Camera) -> RenderedFrame:
        """The avatar at ``time_s`` seconds of ``motion``, seen by ``camera``."""
        return self.draw(self.encode(motion, time_s), camera)

    def encode(self, motion: Motion, time_s: float) -> Encoded:
        """The first half of ``render``; may run in another thread than the second."""
        with self.times.stage("encoders"):
            return self.renderer.avatar.encode(motion, time_s)

    def draw(self, encoded: Encoded, camera: Camera, scale: float = 1.0) -> RenderedFrame:
        """The second half of ``render``; ``scale`` as of ``FrameRenderer.draw``."""
        frame = self.renderer.draw(encoded, camera, aovs=self.aovs, srgb=False, scale=scale)
        for stage, seconds in frame.stage_seconds.items():
            self.times.add(stage, seconds)
        with self.times.stage("background"):
            return replace(frame, background=self._background_radiance(camera))

    def _background_radiance(self, camera: Camera) -> Floats32 | None:
        """Kept for as long as camera and light stand still."""
        if self.background.kind == "none":
            return None
        light = self.renderer.light
        if self._backdrop is None or self._backdrop[0] is not camera or self._backdrop[1] is not light:
            self._backdrop = camera, light, self.background.radiance(camera, light)
        return self._backdrop[2]
