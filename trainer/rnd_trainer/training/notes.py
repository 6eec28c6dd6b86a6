"""Notes on a capture."""

from __future__ import annotations

from collections.abc import Iterable

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.shading.light import light_notes


def capture_notes(capture: Capture, splits: Iterable[Split] = ()) -> list[str]:
    """Notes on the motion, and on the lights of the images in ``splits``."""
    named = {frame.light for split in splits for frame in capture.split(split) if frame.light}
    names = filter(capture.has_map, named)
    lights = (f"{name}: {note}" for name in sorted(names) for note in light_notes(capture.load_light(name)))
    return [*capture.motion.notes, *lights]
