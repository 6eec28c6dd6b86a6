"""Learns an avatar from a monocular capture: the paper's networks, losses and two training stages, in torch."""

import rnd_runtime  # noqa: F401  (before torch: it settles how OpenMP's threads wait)
