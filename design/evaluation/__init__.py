"""How well a pad locates presses."""
