"""One facade that renders a frame of an avatar."""
