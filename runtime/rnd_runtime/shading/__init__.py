"""Light probes, the BRDF, shadows and the shading modes."""
