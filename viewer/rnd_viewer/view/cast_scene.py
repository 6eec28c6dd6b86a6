"""The content of ``rnd-view`` for a scene file: several people under the controls of one."""

from __future__ import annotations

from concurrent.futures import Future
from functools import cached_property

import numpy as np

from rnd_runtime.avatar.networks import Networks
from rnd_runtime.core.camera import Camera
from rnd_runtime.ground.shadow import Plane
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import RenderedFrame
from rnd_runtime.playback.framing import Framing
from rnd_runtime.playback.scene import frame_people, ground_under
from rnd_viewer.inputs.cast import load_people
from rnd_viewer.inputs.scenes import read_scene

from .options import ViewOptions
from .people import ViewedPeople
from .scene import Floats32, Scene, projected
from .state import ViewState


class CastScene(Scene):
    """A ``Scene`` of the people in the scene file ``options.avatar``; the first one's light is the avatar's own.

    Raises:
        InputError: for whatever cannot be used.
    """

    def __init__(self, options: ViewOptions) -> None:
        super().__init__(options)
        self._all = ViewedPeople(self.people, self.renderer)

    def _load(self, options: ViewOptions, ahead: Future[Networks] | None) -> None:
        self.people = load_people(read_scene(options.avatar), options.reading, options.albedo_gain, options.threads)
        self.avatar, self.motion, self.capture = self.people[0].avatar, self.people[0].motion, None

    @property
    def gaussians(self) -> int:
        return sum(person.avatar.gaussians for person in self.people)

    @property
    def duration(self) -> float:
        return max(person.start + person.motion.duration for person in self.people)

    @property
    def motion_name(self) -> str:
        return f"{len(self.people)} {'person' if len(self.people) == 1 else 'people'}"

    def framing(self) -> Framing:
        return frame_people(self.people)

    def parents(self) -> list[int]:
        parents: list[int] = []
        for person in self.people:
            first = len(parents)
            parents += [first + parent if parent >= 0 else -1 for parent in person.avatar.skeleton.parents.tolist()]
        return parents

    def notes(self) -> list[str]:
        return list(dict.fromkeys(note for person in self.people for note in person.motion.notes))

    def frames_at(self, fps: float) -> int:
        return max(person.frames_at(fps) for person in self.people)

    @cached_property
    def _plane(self) -> Plane:
        return ground_under(self.people)

    def _draw(
        self, state: ViewState, camera: Camera, motion: Motion, time_s: float, grounded: bool, seconds: dict[str, float]
    ) -> RenderedFrame:
        return self._draw_people(self._all, state, camera, time_s, self._plane if grounded else None, seconds)

    def _joints(self, motion: Motion, time_s: float, camera: Camera) -> Floats32:
        bodies = self._all.bodies(time_s, camera, {})
        inside = [body.avatar.joints(body) for body in bodies]
        world = [points @ body.root[:3, :3].T + body.root[:3, 3] for points, body in zip(inside, bodies)]
        return projected(np.concatenate(world), camera)
