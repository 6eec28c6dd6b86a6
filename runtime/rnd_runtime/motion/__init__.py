"""Motions: skeletons, retargeting, interpolation and editing."""
