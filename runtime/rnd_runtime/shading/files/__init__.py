"""Files of light probes: reading, and their channels, colours, exposure and orientation."""
