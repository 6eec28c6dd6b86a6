"""The best file within a bound of time, size or error."""
