"""rnd-report: a training on one page."""
