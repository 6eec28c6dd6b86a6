"""rnd-convert: splats, meshes, motions."""
