"""What a user should know of the files that a command of ours learns from or judges by."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.shading.light import light_notes


def say_notes(program: str, notes: Iterable[str]) -> None:
    """One line each on stderr."""
    for note in notes:
        print(f"{program}: {note}", file=sys.stderr)  # noqa: T201


def capture_notes(capture: Capture, splits: Iterable[Split] = ()) -> list[str]:
    """Of a capture's motion, and of the lights that pictures of ``splits`` name."""
    names = {frame.light for split in splits for frame in capture.split(split) if frame.light}
    lights = (f"{name}: {note}" for name in sorted(names) for note in light_notes(capture.load_light(name)))
    return [*capture.motion.notes, *lights]
