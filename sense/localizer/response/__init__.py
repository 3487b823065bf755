"""How a pad answers to a press, and what its answers so say of a place."""
