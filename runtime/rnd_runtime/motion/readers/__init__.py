"""Readers of motion files, one family of formats a module."""
