"""What files of light probes state: channels, colours, exposure and orientation."""
