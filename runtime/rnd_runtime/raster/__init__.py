"""Rasterisers of the CPU: projection, tiles, blending, tone mapping, and the float64 oracle."""
