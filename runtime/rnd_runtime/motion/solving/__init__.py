"""Rotations of a skeleton's joints from the positions of a recording."""
