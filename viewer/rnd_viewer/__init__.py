"""Everything people look at: frames and videos, live pages, conversions, reports."""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
