"""Fewer Gaussians and coarser networks."""
