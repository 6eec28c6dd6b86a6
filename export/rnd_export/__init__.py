"""Freezes a trained avatar to one self-contained ONNX file and measures its difference from torch."""
