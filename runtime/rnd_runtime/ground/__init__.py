"""The ground that a body stands on, and its shadow there."""
