"""rnd-view: a live view in the browser."""
