"""Masks and normals of a data set: from files or estimated."""
