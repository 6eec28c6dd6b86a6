"""Features of AOVs that need more than one frame's Gaussians: motion to the next frame, and parts by joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rnd_runtime.avatar.avatar import Encoded
from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.playback.aov import pixel_motion
from rnd_runtime.playback.framing import CameraPath
from rnd_runtime.playback.scene import Person
from rnd_runtime.posing.window import moment


@dataclass(frozen=True, eq=False)
class GivenFeatures:
    """Features of ``person`` in a run of ``count`` frames at ``fps``."""

    person: Person
    fps: float
    count: int
    camera_at: CameraPath
    aovs: Sequence[str]

    def of(self, number: int, encoded: Encoded, camera: Camera) -> Mapping[str, Floats32]:
        """Features [N, C] by name, for ``FrameRenderer.draw``, of a frame that is encoded already."""
        given = {}
        if "motion" in self.aovs:
            given["motion"] = self._motion(number, encoded, camera)
        if "parts" in self.aovs:
            given["parts"] = self._parts
        return given

    def _motion(self, number: int, encoded: Encoded, camera: Camera) -> Floats32:
        avatar = self.person.avatar
        following = number + 1 if self.person.motion.closed else min(number + 1, self.count - 1)
        later = self.person.encode(following / self.fps)
        now, then = avatar.posed(encoded), avatar.posed(later)
        try:
            next_camera = self.camera_at(following, following / self.fps)
        except IndexError:  # the last of a file with one camera per frame
            next_camera = camera
        return pixel_motion(now, camera.in_frame(encoded.root), then, next_camera.in_frame(later.root))

    @cached_property
    def _parts(self) -> Floats32:
        """One-hot [N, J]: the joint with the largest weight in the first pose."""
        avatar = self.person.avatar
        first = moment(
            self.person.motion, 0.0, avatar.skeleton, poses=avatar.window_poses, seconds=avatar.window_seconds
        )
        (weights,) = avatar.run((first.window, first.velocity, first.bones), ("skinning_weights",))
        return np.eye(weights.shape[1], dtype=np.float32)[weights.argmax(axis=1)]
