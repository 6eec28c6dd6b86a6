"""The light stage: coded people, path-traced from many views under many lights, with ground truth for every image."""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
