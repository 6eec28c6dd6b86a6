"""Learns an avatar from a monocular capture: the paper's networks, losses and two training stages, in torch."""

import rnd_runtime  # noqa: F401  (before torch and numba: how OpenMP's threads wait, where kernels are kept)
