"""Cameras, lights and motions, and the capture that is written."""
