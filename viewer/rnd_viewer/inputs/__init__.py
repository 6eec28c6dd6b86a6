"""Options that commands share: cameras, lights, backgrounds."""
