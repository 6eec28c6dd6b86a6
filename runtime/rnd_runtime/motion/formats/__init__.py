"""Motions on skeletons of their own or as bare positions, and the choice of a reader."""
