"""The light stage: coded people, path-traced from many sides under many lights, with the truth beside every image.

``people`` describes and dresses them, ``render`` path-traces them with Mitsuba 3, ``film`` has cameras, lights, motions
and writes the capture.
"""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
