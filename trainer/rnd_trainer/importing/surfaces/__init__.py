"""Masks and normals, made where a data set has none."""
