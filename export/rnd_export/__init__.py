"""Freezes a trained avatar to one self-contained ONNX file and measures its difference from torch."""

import rnd_runtime.core  # noqa: F401  (handles signals while the rest of a command is imported)
