"""Posed Gaussians of an avatar at a moment of a motion."""
