"""Light of a capture: its search, and what fixes the colour that it shares with albedo."""
