"""Studies of many trainings."""
