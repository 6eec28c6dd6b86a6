"""rnd-train, rnd-eval and rnd-data."""
