"""What the rows measure, a module a subject."""
