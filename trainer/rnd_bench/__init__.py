"""The laboratory: benchmarks, the stability suite and studies."""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
