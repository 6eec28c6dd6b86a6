"""Differentiable shading and splatting."""
