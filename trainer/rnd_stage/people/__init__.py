"""Bodies, garments and materials."""
