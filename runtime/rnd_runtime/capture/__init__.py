"""Captures and bodies on disk."""
