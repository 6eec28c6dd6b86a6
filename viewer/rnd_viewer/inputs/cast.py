"""The people of a scene, loaded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.networks import Networks
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.scene import Person, place_at

from .options import MotionOptions, parse_gain
from .scenes import PersonRecord


def load_people(
    cast: Sequence[PersonRecord],
    reading: MotionOptions,
    albedo_gain: str = "1",
    threads: int | None = None,
    *,
    ahead: Future[Networks] | None = None,
) -> list[Person]:
    """Load ``cast``: every avatar once, every motion once for each avatar. ``ahead``: networks of a lone avatar."""
    avatars: dict[Path, Avatar] = {}
    motions: dict[tuple[Path, Path], Motion] = {}
    people = []
    for record in cast:
        file, source = record.avatar.resolve(), record.motion.resolve()
        if file not in avatars:
            avatars[file] = Avatar.load(record.avatar, threads=threads, ahead=ahead)
            avatars[file].scale_albedo(parse_gain(albedo_gain))
        if (file, source) not in motions:
            motions[file, source] = reading.read_motion(record.motion, avatars[file].skeleton)
        place = place_at(*record.position, math.radians(record.heading))
        people.append(Person(avatars[file], motions[file, source], record.start, place))
    return people
