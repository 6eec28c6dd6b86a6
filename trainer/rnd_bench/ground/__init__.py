"""Shadows on the ground: their error against Mitsuba, and what they cost a frame."""
