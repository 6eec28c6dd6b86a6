"""People in ``rnd-view``, at the levels of detail that a view needs."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

from rnd_runtime.avatar.avatar import Encoded
from rnd_runtime.core.camera import Camera
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.scene import Person, SceneRenderer


class ViewedPeople(SceneRenderer):
    """A ``SceneRenderer`` of single views; poses are kept while time and levels of detail stay."""

    def __init__(self, people: Sequence[Person], renderer: FrameRenderer) -> None:
        super().__init__(people, renderer)
        self._encoded: tuple[float, list[int], list[Encoded]] | None = None

    def levels_at(self, time_s: float, camera: Camera) -> list[int]:
        """Level of detail of each person."""
        levels: list[int] = self.levels(1, 1.0, lambda frame, at: camera, start=time_s)[0].tolist()
        return levels

    def bodies(self, time_s: float, camera: Camera, seconds: dict[str, float]) -> list[Encoded]:
        """Everybody's pose, for ``draw``; adds to the stages' ``seconds``."""
        levels = self.levels_at(time_s, camera)
        if self._encoded is None or self._encoded[:2] != (time_s, levels):
            started = perf_counter()
            self._encoded = time_s, levels, self.encode(time_s, levels)
            seconds["encoders"] = perf_counter() - started
        return self._encoded[2]
