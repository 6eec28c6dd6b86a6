"""Scores of held-out frames."""
