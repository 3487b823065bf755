"""Two contacts at once."""
