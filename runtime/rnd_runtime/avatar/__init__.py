"""The avatar file and its networks."""
