"""What is wrong with a capture, before training."""
