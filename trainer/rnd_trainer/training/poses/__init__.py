"""Body poses of a training: what jitters in them, how sure they are, and their corrections."""
