"""rnd-play: frames and clips."""
