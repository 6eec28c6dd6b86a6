"""Studies of many trainings, and of the light stage."""
