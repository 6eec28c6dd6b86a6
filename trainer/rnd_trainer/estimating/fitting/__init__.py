"""The joint fit of a parametric body to what networks see of a person over a clip."""
