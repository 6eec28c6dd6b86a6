"""From a moment of a motion to posed Gaussians."""
