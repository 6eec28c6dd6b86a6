"""Freezes a trained avatar to one self-contained ONNX file, and proves that it still says the same."""
