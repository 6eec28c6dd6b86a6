"""Checks of a capture before training."""
