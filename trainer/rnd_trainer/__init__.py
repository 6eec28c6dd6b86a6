"""Learns an avatar from a monocular capture: the paper's networks, losses and two training stages, in torch."""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
