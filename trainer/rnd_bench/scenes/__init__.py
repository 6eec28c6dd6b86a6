"""Subjects, poses, lights and avatars that benchmarks and the stability suite share."""
